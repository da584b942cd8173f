"""The CUDA backend beside the suites of all backends: cutting up, compiling, memory, and where there is no GPU."""

import math
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, GaussianScene, LinearProbe, render
from ultragray.errors import BackendUnavailable, FrameTooCostly, MemoryExceeded
from ultragray.rendering.backends import cuda
from ultragray.rendering.limits import Limits
from ultragray.rendering.outputs import PLANES

pytest.importorskip("triton", reason="the package triton is not installed, which runs these kernels")

from ultragray.rendering.backends.cuda import frames, launch
from ultragray.rendering.backends.cuda.work import count_work

LINEAR = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=60.0)
SIZE = {"height": 21, "width": 37}


@pytest.fixture
def scene(random_scene, on_device):
    return on_device(random_scene(40, sigma_cm=(0.05, 0.3)))


@pytest.fixture
def shapes_of_a_gpu(monkeypatch):
    """Interpreted kernels are cut up as on a GPU: more and smaller steps, one slice at a time."""
    monkeypatch.setattr(launch, "INTERPRETER_SHAPES", launch.GPU_SHAPES)
    return


def planes(scene, probe, poses, backend="cuda"):  # [4, C, H, W]
    rendered = render(scene, probe, poses, backend=backend, **SIZE)
    return np.stack([getattr(rendered, name).detach().cpu().double().numpy() for name in PLANES])


def gradient(scene, probe, poses, backend):
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in scene.splats.items()}
    rendered = render(GaussianScene.from_splats(leaves, info=scene.info), probe, poses, backend=backend, **SIZE)
    sum(getattr(rendered, name).square().sum() for name in PLANES).backward()
    return {name: leaf.grad.cpu().double().numpy() for name, leaf in leaves.items() if leaf.grad is not None}


@pytest.mark.long
@pytest.mark.usefixtures("shapes_of_a_gpu")
@pytest.mark.parametrize("probe", [LINEAR, CONVEX], ids=["linear", "convex"])
def test_cut_up_as_on_a_gpu(probe, random_scene, random_poses):
    """Several blocks, tiles and chunks; frames and gradients as the reference's in float64."""
    scene, poses = random_scene(150, transmittance_logit=(-4, 2)), random_poses(1, seed=8)
    exact = scene.to(torch.float64)
    difference = np.abs(planes(scene.to(cuda.device()), probe, poses) - planes(exact, probe, poses, "reference"))
    assert np.quantile(difference, 0.999) < 1e-4
    want = gradient(exact, probe, poses, "reference")
    for name, got in gradient(scene.to(cuda.device()), probe, poses, "cuda").items():
        error = np.linalg.norm(got - want[name]) / np.linalg.norm(want[name])
        assert error < 1e-3, f"{name}: relative L2 error {error:.2g}"


def one(mean, log_scales, transmittance=-5.0):
    """One Gaussian: its mean in cm, its raw scales and transmittance."""
    raw = {
        "means": torch.tensor([mean]),
        "scales": torch.tensor([log_scales]),
        "quats": torch.tensor([[1.0, 0.2, -0.1, 0.3]]),
        "transmittances": torch.tensor([transmittance]),
        "sh0": torch.zeros(1, 1, 1),
    }
    return GaussianScene.from_splats(raw)


@pytest.mark.usefixtures("shapes_of_a_gpu")
def test_lines_of_the_far_side_of_a_wide_fan_are_not_absorbed(on_device):
    """Behind the apex such a line comes close to the Gaussian, and a tile may hold lines of both sides."""
    scene = one((4 * math.sin(1.5), 0.0, 4 * math.cos(1.5)), (-1.2, -1.2, -1.2))
    probe = ConvexProbe(opening_angle_deg=175.0, near_mm=0.0, far_mm=50.0)
    size = {"height": 40, "width": 16}
    exact = render(scene.to(torch.float64), probe, np.eye(4), backend="reference", **size)
    frames = render(on_device(scene), probe, np.eye(4), backend="cuda", **size)
    assert exact.transmittance.min() < 0.9
    assert (frames.transmittance.cpu() - exact.transmittance).abs().max() < 1e-4


@pytest.mark.parametrize("probe", [LINEAR, CONVEX], ids=["linear", "convex"])
def test_gradients_of_a_thin_sheet_keep_their_digits(probe, on_device):
    scene = one((0.3, 0.05, 2.5), (0.0, 0.0, math.log(0.003)), transmittance=1.0)
    want = gradient(scene.to(torch.float64), probe, np.eye(4), "reference")
    got = gradient(on_device(scene), probe, np.eye(4), "cuda")
    for name in ("means", "scales", "quats"):
        assert np.linalg.norm(got[name] - want[name]) < 2e-4 * np.linalg.norm(want[name]), name


def test_a_parameter_that_changes_before_the_backward_pass_is_noticed(scene):
    scene.means.requires_grad_()
    bmode = render(scene, LINEAR, np.eye(4), backend="cuda", **SIZE).bmode
    scene.scales.add_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        bmode.sum().backward()


def test_a_frame_comes_out_the_same_every_time(scene, random_poses):
    poses = random_poses(1)
    first, again = planes(scene, CONVEX, poses), planes(scene, CONVEX, poses)
    np.testing.assert_array_equal(first, again)
    one, two = (gradient(scene, LINEAR, poses, "cuda") for _ in range(2))
    for name, value in one.items():
        np.testing.assert_array_equal(value, two[name])


def test_poses_beyond_the_workspace_go_in_rounds(scene, random_poses, monkeypatch):
    poses = random_poses(3)
    together = planes(scene, LINEAR, poses)
    geometry = launch.Geometry.of(LINEAR, SIZE["height"], SIZE["width"])
    rounds = []
    cut = frames.cut

    def counted(gaussians, views, *rest, **options):
        rounds.append(len(views))
        return cut(gaussians, views, *rest, **options)

    monkeypatch.setattr(frames, "cut", counted)
    monkeypatch.setattr(frames, "WORKSPACE_BYTES", 2 * launch.bytes_per_pose(scene.gaussian_count, geometry))
    np.testing.assert_array_equal(planes(scene, LINEAR, poses), together)
    assert rounds == [2, 1]


def test_the_spatial_order_is_made_once(scene, random_poses, monkeypatch):
    planes(scene, LINEAR, random_poses(1))
    kept = frames.sorted_gaussians(scene)
    assert frames.sorted_gaussians(scene) is kept
    scene.sh0.add_(0.1)
    assert frames.sorted_gaussians(scene) is not kept


def test_out_of_memory_fails_the_frame_and_nothing_else(scene, random_poses, monkeypatch):
    poses = random_poses(3)
    before = planes(scene, LINEAR, poses)

    def full(*arguments, **options):
        raise torch.OutOfMemoryError("CUDA out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(frames, "cut", full)
        with pytest.raises(MemoryExceeded, match=r"does not suffice for 3 frames of 21x37 pixels from 40 Gaussians"):
            planes(scene, LINEAR, poses)
    with monkeypatch.context() as patch:
        patch.setattr(frames, "differentiate", full)
        with pytest.raises(MemoryExceeded, match="does not suffice for the gradient of 3 frames"):
            gradient(scene, LINEAR, poses, "cuda")
    np.testing.assert_array_equal(planes(scene, LINEAR, poses), before)


def test_it_refuses_what_it_would_get_wrong(scene):
    with pytest.raises(BackendUnavailable, match=r"backend cuda renders float32 scenes on the device .*float64"):
        render(scene.to(torch.float64), LINEAR, np.eye(4), backend="cuda", **SIZE)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_without_a_gpu_it_says_so(random_scene, monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET")
    assert not cuda.available()
    with pytest.raises(BackendUnavailable, match=r"needs an NVIDIA GPU .*; the CPU does the same"):
        render(random_scene(3), LINEAR, np.eye(4), backend="cuda", **SIZE)
    with pytest.raises(BackendUnavailable, match="needs an NVIDIA GPU"):
        cuda.device()
    assert render(random_scene(3), LINEAR, np.eye(4), **SIZE).bmode is not None


def test_a_device_that_is_not_there_is_named():
    if cuda.interpreted():
        pytest.skip("interpreted kernels know no device numbers")
    with pytest.raises(BackendUnavailable, match=r"CUDA device 99 was asked for"):
        cuda.device(99)


COMPILE = """
import re, subprocess, sys
from pathlib import Path
import numpy as np, torch, triton
from triton.backends.compiler import GPUTarget
from triton.runtime import driver
from triton.runtime.jit import JITFunction
from ultragray import ConvexProbe, GaussianScene, LinearProbe, RadialProbe
from ultragray.rendering.backends import cuda

class Driver:  # of a GPU that is only compiled for
    def get_current_target(self): return GPUTarget("cuda", int(sys.argv[1]), 32)
    def get_current_device(self): return 0
    def get_current_stream(self, device): return 0

driver.set_active(Driver())
compiled, launch = {}, JITFunction.run

def compile_only(kernel, *arguments, grid, warmup, **options):
    made = launch(kernel, *arguments, grid=grid, warmup=True, **options)
    compiled.setdefault(made.hash, (kernel.__name__, made.asm["cubin"]))

JITFunction.run = compile_only
probes = {0: LinearProbe(40, 0, 50), 1: RadialProbe(1, 20), 3: ConvexProbe(60, near_mm=10, far_mm=60)}
for degree, probe in ((degree, probes[degree]) for degree in map(int, sys.argv[3:])):
    raw = {"means": (9, 3), "scales": (9, 3), "quats": (9, 4), "transmittances": (9,), "sh0": (9, 1, 1)}
    splats = {name: torch.rand(shape) for name, shape in raw.items()}
    splats["shN"] = torch.rand(9, (degree + 1) ** 2 - 1, 1)
    cuda.render_outputs(GaussianScene.from_splats(splats), probe, np.eye(4)[None], 33, 47, ("bmode",))
    for tensor in splats.values():
        tensor.requires_grad_()
    scene = GaussianScene.from_splats(splats)
    cuda.render_outputs(scene, probe, np.eye(4)[None], 33, 47, ("bmode", "coverage"))["coverage"].sum().backward()
    pose = torch.eye(4, dtype=torch.float64)[None].requires_grad_()
    cuda.render_outputs(scene, probe, pose, 33, 47, ("bmode",))["bmode"].sum().backward()

cubin, tool = Path(sys.argv[2], "kernel.cubin"), Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"
for name, code in compiled.values():
    cubin.write_bytes(code)
    usage = subprocess.run([tool, "-res-usage", cubin], capture_output=True, text=True, check=True).stdout
    print(name, *re.findall(r"(?:REG|STACK):\\d+", usage))
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("capability", "degrees"),
    [
        pytest.param("90", ["3"], marks=pytest.mark.slow),
        pytest.param("90", ["0", "1"], marks=pytest.mark.long),
        pytest.param("80", ["0", "1", "3"], marks=pytest.mark.long),
    ],
)
def test_every_launch_compiles_for_gpus_and_keeps_to_its_registers(capability, degrees, tmp_path):
    """Triton's compiler needs no GPU, and sees what the interpreter does not, such as a type that changes in a loop."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    environment["TRITON_CACHE_DIR"] = str(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", COMPILE, capability, str(tmp_path), *degrees],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    used = [line.split() for line in done.stdout.splitlines()]
    assert len({name for name, *_ in used}) == 6
    for name, *resources in used:
        found = {kind: int(number) for kind, number in (resource.split(":") for resource in resources)}
        assert found["STACK"] <= 128, f"{name} spills registers: {found}"  # the sine of a large angle takes 48 bytes


def test_work_is_counted_from_real_slices(on_device):
    pair = GaussianScene.from_splats(
        {
            "means": torch.tensor([[0.0, 0.0, 2.5], [0.0, 2.0, 2.5]]),  # the second is out of the plane
            "scales": torch.full((2, 3), -3.0),
            "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2),
            "transmittances": torch.full((2,), 30.0),
            "sh0": torch.zeros(2, 1, 1),
        }
    )
    scene = on_device(pair)
    work = count_work(scene, LINEAR, scene.poses_to_scene_cm(np.eye(4)[None]), 512, 512)
    assert work.gaussians == 2
    assert work.slices == 1
    # e^-3 cm = 0.498 mm: 3.33 deviations to all sides at 12.8 columns and 10.24 rows a millimetre, 4.9 below
    assert 42 * (16 + 24) < work.footprint_pixels < 46 * (19 + 29)
    assert work.tile_visits >= work.footprint_pixels / (launch.shapes().tile_rows * launch.shapes().tile_columns)
    assert work.bytes_read > 2 * 40 + 3 * 4 * 512 * 512


@pytest.mark.gpu
def test_a_frame_asked_for_again_is_replayed_for_its_own_pose(scene, random_poses):
    """The launches of a single frame are recorded as a CUDA graph: its frames are those of the batch."""
    poses = random_poses(6)
    together = planes(scene, LINEAR, poses)
    kept = [planes(scene, LINEAR, pose[None]) for pose in poses]
    np.testing.assert_array_equal(np.concatenate(kept, axis=1), together)
    for probe in (CONVEX, LINEAR, LinearProbe(30.0, 0.0, 50.0), LinearProbe(31.0, 0.0, 50.0), CONVEX):
        one_by_one = [planes(scene, probe, pose[None]) for pose in poses[:3]]
        np.testing.assert_array_equal(np.concatenate(one_by_one, axis=1), planes(scene, probe, poses[:3]))


@pytest.mark.gpu
def test_a_replayed_frame_follows_the_scene_and_keeps_to_its_limit(scene, random_poses):
    pose = random_poses(1)
    before = [planes(scene, LINEAR, pose) for _ in range(3)][-1]
    scene.transmittances.sub_(1.0)
    np.testing.assert_array_equal(planes(scene, LINEAR, pose), planes(scene, LINEAR, pose.repeat(2, 0))[:, :1])
    assert np.abs(planes(scene, LINEAR, pose) - before).max() > 1e-3
    for _ in range(3):
        with pytest.raises(FrameTooCostly, match="footprint pixels"):
            cuda.render_outputs(
                scene, LINEAR, scene.poses_to_scene_cm(pose), 21, 37, ("bmode",), Limits(footprint_pixels=1)
            )


@pytest.mark.gpu
def test_threads_replay_frames_of_their_own(scene, random_poses):
    poses = random_poses(64)
    together = planes(scene, LINEAR, poses)
    with ThreadPoolExecutor(8) as threads:
        frames = list(threads.map(lambda pose: planes(scene, LINEAR, pose[None]), poses))
    np.testing.assert_array_equal(np.concatenate(frames, axis=1), together)


@pytest.mark.gpu
@pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype")
def test_rendering_never_waits_for_the_device(scene, random_poses):
    poses = random_poses(3)
    for some in (poses, poses[:1], poses[:1]):  # compiles, sorts, records
        planes(scene, LINEAR, some)
    torch.cuda.set_sync_debug_mode("error")
    try:
        render(scene, LINEAR, poses, backend="cuda", **SIZE)
        render(scene, LINEAR, poses[0], backend="cuda", **SIZE)
    finally:
        torch.cuda.set_sync_debug_mode("default")
