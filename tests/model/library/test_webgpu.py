"""The shaders of a page on this machine's Vulkan driver, of a GPU or in software, by a compiler that no browser has."""

import ctypes
import json
import os
import runpy
import struct
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from ultragray import render
from ultragray.contract import from_dict
from ultragray.geometry.probe import ElevationBeam, Probe
from ultragray.rendering.outputs import PLANES

from ...conftest import LARGEST_FLIP
from .test_library import Plan, Scene, library

__all__ = ["library"]

wgpu = pytest.importorskip("wgpu")
ROOT = Path(__file__).parents[3]
SHADERS = ROOT / "browser" / "src" / "gpu"
random_probe = runpy.run_path(str(ROOT / "tests" / "browser" / "make_frames.py"))["random_probe"]
SCENES = int(os.environ.get("ULTRAGRAY_TEST_WEBGPU_SCENES", "12"))
POSES = 4  # of each scene
TWO_LINES = 214  # a seed: an image all the way round of two scan lines, each behind the other
# As browser/src/gpu/renderer.ts has them.
BLOCK, TILE, COLUMNS = 128, 16, 64
SLICE_BYTES, EXTENT_BYTES, BOUNDS_BYTES = 40, 28, 20
FAR = 1e30


@pytest.fixture(scope="module")
def device():
    try:
        adapter = wgpu.gpu.request_adapter_sync(power_preference="high-performance")
    except RuntimeError as error:
        pytest.skip(f"there is no WebGPU adapter: {error}")
    return adapter.request_device_sync()


@cache
def compiled(device, fanned, wrap, thick, sigmoid, degree):
    """The passes slice, draw and finish."""
    lines = {"FANNED": fanned, "WRAP": wrap}
    constants = {
        "slice": lines | {"THICK": thick, "SIGMOID": sigmoid, "DEGREE": degree},
        "draw": lines,
        "finish": lines,
    }
    common = (SHADERS / "common.wgsl").read_text()
    passes = []
    for name, given in constants.items():
        module = device.create_shader_module(code=common + (SHADERS / f"{name}.wgsl").read_text())
        compute = {"module": module, "entry_point": "main", "constants": given}
        passes.append(device.create_compute_pipeline(layout="auto", compute=compute))
    return passes


def view_of(plan, count):
    """The struct View of common.wgsl."""
    axes, origin = np.reshape(plan.axes, (3, 3)), np.array(plan.origin)
    rows = [[*axis, value] for axis, value in zip(axes, (plan.near_cm, plan.row_cm, plan.most_cm), strict=True)]
    places = [[*origin, plan.start], [*(origin - origin.astype(np.float32)), plan.span / plan.width]]
    numbers = np.minimum([*rows, *places, plan.beam], FAR).astype(np.float32)
    size = count, int(plan.height), int(plan.width)
    return numbers.tobytes() + struct.pack("<4if3i", *range(len(PLANES)), np.linalg.det(axes), *size)


def angles_of(plan):  # [2, W, 2]
    line, pitch = np.arange(int(plan.width)), plan.span / plan.width
    angle, turn = plan.start + pitch * (line + 0.5), pitch * line
    return np.stack([np.sin([angle, turn]), [np.cos(angle), 2.0 * np.sin(turn / 2.0) ** 2]], axis=2).astype(np.float32)


def drawn(device, library, held, plan):
    """All planes [4, H, W] of a plan."""
    info, found = json.loads(library.ultragray_scene_info(held.pointer)), ctypes.c_size_t()
    gaussians, harmonics = library.ultragray_gaussians(held.pointer, found), library.ultragray_harmonics(held.pointer)
    degree, count, height, width = info["sh_degree"], found.value, int(plan.height), int(plan.width)
    blocks, rows = -(-count // BLOCK), -(-height // TILE)

    def filled(values, usage=wgpu.BufferUsage.STORAGE):
        return device.create_buffer_with_data(data=values, usage=usage)

    def room(size):
        return device.create_buffer(size=size, usage=wgpu.BufferUsage.STORAGE | wgpu.BufferUsage.COPY_SRC)

    view = filled(view_of(plan, count), wgpu.BufferUsage.UNIFORM)
    terms = (degree + 1) ** 2
    scene = [filled(np.ctypeslib.as_array(*one)) for one in ((gaussians, (count, 12)), (harmonics, (count, terms)))]
    cut = [room(blocks * size) for size in (BLOCK * SLICE_BYTES, BLOCK * EXTENT_BYTES, BOUNDS_BYTES)]
    sums, steps, planes = (room(4 * size) for size in (3 * height * width, rows * width, len(PLANES) * height * width))
    angles = filled(angles_of(plan))
    bound = [view, *scene, angles, *cut], [view, *cut, angles, sums, steps], [view, sums, steps, planes]
    groups = (blocks, 1), (-(-width // TILE), rows), (-(-width // COLUMNS), rows)
    passes = compiled(device, plan.fanned, plan.wrap, plan.beam[0] > 0, info["intensity"] == "sigmoid", degree)
    encoder = device.create_command_encoder()
    work = encoder.begin_compute_pass()
    for pipeline, buffers, size in zip(passes, bound, groups, strict=True):
        entries = [{"binding": place, "resource": {"buffer": one}} for place, one in enumerate(buffers)]
        work.set_pipeline(pipeline)
        work.set_bind_group(0, device.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=entries))
        work.dispatch_workgroups(*size)
    work.end()
    device.queue.submit([encoder.finish()])
    return np.frombuffer(device.queue.read_buffer(planes), np.float32).reshape(len(PLANES), height, width)


@pytest.mark.parametrize("seed", sorted({*range(SCENES), TWO_LINES}))
def test_random_planes_are_those_of_the_reference(device, library, random_scene, random_poses, seed):
    random = np.random.default_rng(seed)
    look = {"sh_degree": int(random.integers(4)), "intensity": str(random.choice(["released", "sigmoid"]))}
    widest_cm = random.choice([0.1, 0.3, 1.0])
    scene = random_scene(int(random.integers(1, 1000)), seed=seed, sigma_cm=(0.01, widest_cm), **look)
    held = Scene(library, scene.to_bytes())
    values, flips, largest = 0, np.zeros(len(PLANES), dtype=int), 0.0
    for pose in random_poses(POSES, seed=seed):
        height, width = (int(side) for side in random.integers(1, 90, 2))
        probe, thickness_mm = random_probe(random), float(random.choice([0.0, random.uniform(0.1, 5.0)]))
        settings = {"probe": probe, "height": height, "width": width, "outputs": PLANES}
        settings["slice_thickness_mm"] = thickness_mm
        view = library.ultragray_prepare(held.pointer, json.dumps(settings).encode())
        assert view, held.problem
        plan = Plan()
        assert library.ultragray_plan_of(view, np.ascontiguousarray(pose).ctypes.data, plan) == 0, held.problem
        planes = drawn(device, library, held, plan)
        library.ultragray_free_view(view)
        size, beam = {"height": height, "width": width}, ElevationBeam(thickness_mm)
        exact = render(scene.to(torch.float64), from_dict(Probe, probe), pose, beam=beam, backend="reference", **size)
        apart = np.abs(planes - np.stack([exact[name][0].numpy() for name in PLANES]))
        values += height * width
        flips += (apart > 5e-4).sum(axis=(1, 2))
        largest = max(largest, apart.max())
    library.ultragray_free_scene(held.pointer)
    # Where a Gaussian just reaches 1/255 for one of the two: of small images, a single pixel may be more than a share.
    told = f"{dict(zip(PLANES, flips, strict=True))} of {values} pixels differ, the worst by {largest:.3g}"
    assert flips.max() <= max(1, values / 10_000), told
    assert largest <= LARGEST_FLIP, told
