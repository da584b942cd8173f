"""The CUDA backend beside the suites of all backends: cutting up, compiling, memory, and where there is no GPU."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, GaussianScene, LinearProbe, Probe, cuda, render
from ultragray.errors import BackendUnavailable, MemoryExceeded
from ultragray.rendering import renderer_name
from ultragray.request import OUTPUTS

pytest.importorskip("triton", reason="the package triton is not installed, which runs these kernels")

from ultragray.cuda import frames, launch
from ultragray.cuda.work import count_work

LINEAR = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=60.0)
SIZE = {"height": 21, "width": 37}


@pytest.fixture
def scene(random_scene: Callable[..., GaussianScene], on_device: Callable[..., GaussianScene]) -> GaussianScene:
    return on_device(random_scene(40, sigma_cm=(0.05, 0.3)))


@pytest.fixture
def shapes_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Interpreted kernels are cut up as on a GPU: more and smaller steps, one slice at a time."""
    monkeypatch.setattr(launch, "INTERPRETER_SHAPES", launch.GPU_SHAPES)
    return


def planes(scene: GaussianScene, probe: Probe, poses: Any, backend: str = "cuda") -> np.ndarray:  # [4, C, H, W]
    rendered = render(scene, probe, poses, backend=backend, **SIZE)
    return np.stack([getattr(rendered, name).detach().cpu().double().numpy() for name in OUTPUTS])


def gradient(scene: GaussianScene, probe: Probe, poses: Any, backend: str) -> dict[str, np.ndarray]:
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in scene.splats.items()}
    rendered = render(GaussianScene.from_splats(leaves, info=scene.info), probe, poses, backend=backend, **SIZE)
    sum(getattr(rendered, name).square().sum() for name in OUTPUTS).backward()
    return {name: leaf.grad.cpu().double().numpy() for name, leaf in leaves.items() if leaf.grad is not None}


@pytest.mark.usefixtures("shapes_of_a_gpu")
@pytest.mark.parametrize("probe", [LINEAR, CONVEX], ids=["linear", "convex"])
def test_cut_up_as_on_a_gpu(probe: Probe, random_scene: Callable[..., GaussianScene], random_poses: Any) -> None:
    """Several blocks, tiles and chunks; frames and gradients as the reference's in float64."""
    scene, poses = random_scene(150, transmittance_logit=(-4, 2)), random_poses(1, seed=8)
    exact = scene.to(torch.float64)
    difference = np.abs(planes(scene.to(cuda.device()), probe, poses) - planes(exact, probe, poses, "reference"))
    assert np.quantile(difference, 0.999) < 1e-4
    want = gradient(exact, probe, poses, "reference")
    for name, got in gradient(scene.to(cuda.device()), probe, poses, "cuda").items():
        error = np.linalg.norm(got - want[name]) / np.linalg.norm(want[name])
        assert error < 1e-3, f"{name}: relative L2 error {error:.2g}"


def test_a_frame_comes_out_the_same_every_time(scene: GaussianScene, random_poses: Any) -> None:
    poses = random_poses(2)
    first, again = planes(scene, CONVEX, poses), planes(scene, CONVEX, poses)
    np.testing.assert_array_equal(first, again)
    one, two = (gradient(scene, LINEAR, poses, "cuda") for _ in range(2))
    for name, value in one.items():
        np.testing.assert_array_equal(value, two[name])


def test_poses_beyond_the_workspace_go_in_rounds(
    scene: GaussianScene, random_poses: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses = random_poses(5)
    together = planes(scene, LINEAR, poses)
    geometry = launch.Geometry.of(LINEAR, SIZE["height"], SIZE["width"])
    rounds: list[int] = []
    cut = frames.cut

    def counted(gaussians: Any, views: Any, *rest: Any, **options: Any) -> Any:
        rounds.append(len(views))
        return cut(gaussians, views, *rest, **options)

    monkeypatch.setattr(frames, "cut", counted)
    monkeypatch.setattr(frames, "WORKSPACE_BYTES", 2 * launch.bytes_per_pose(scene.gaussian_count, geometry))
    np.testing.assert_array_equal(planes(scene, LINEAR, poses), together)
    assert rounds == [2, 2, 1]


def test_the_spatial_order_is_made_once(
    scene: GaussianScene, random_poses: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    planes(scene, LINEAR, random_poses(1))
    kept = frames.sorted_gaussians(scene)
    assert frames.sorted_gaussians(scene) is kept
    scene.sh0.add_(0.1)
    assert frames.sorted_gaussians(scene) is not kept


def test_out_of_memory_fails_the_frame_and_nothing_else(
    scene: GaussianScene, random_poses: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses = random_poses(3)
    before = planes(scene, LINEAR, poses)

    def full(*arguments: Any, **options: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(frames, "cut", full)
        with pytest.raises(MemoryExceeded, match=r"does not suffice for 3 frames of 21x37 pixels from 40 Gaussians"):
            planes(scene, LINEAR, poses)
    np.testing.assert_array_equal(planes(scene, LINEAR, poses), before)


def test_frames_say_what_rendered_them(scene: GaussianScene) -> None:
    assert renderer_name("cuda", scene).endswith("cuda-interpreted" if cuda.interpreted() else "")
    assert " cuda-" in renderer_name("cuda", scene)


def test_auto_leaves_scenes_of_the_cpu_to_the_cpu(random_scene: Callable[..., GaussianScene]) -> None:
    assert " cpu-" in renderer_name("auto", random_scene(3))


def test_it_refuses_what_it_would_get_wrong(scene: GaussianScene) -> None:
    with pytest.raises(BackendUnavailable, match=r"backend cuda renders float32 scenes on the device .*float64"):
        render(scene.to(torch.float64), LINEAR, np.eye(4), backend="cuda", **SIZE)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_without_a_gpu_it_says_so(random_scene: Callable[..., GaussianScene], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRITON_INTERPRET")
    assert not cuda.available()
    with pytest.raises(BackendUnavailable, match=r"needs an NVIDIA GPU .*; use backend cpu"):
        render(random_scene(3), LINEAR, np.eye(4), backend="cuda", **SIZE)
    with pytest.raises(BackendUnavailable, match="needs an NVIDIA GPU"):
        cuda.device()
    assert render(random_scene(3), LINEAR, np.eye(4), **SIZE).bmode is not None


def test_a_device_that_is_not_there_is_named() -> None:
    if cuda.interpreted():
        pytest.skip("interpreted kernels know no device numbers")
    with pytest.raises(BackendUnavailable, match=r"CUDA device 99 was asked for"):
        cuda.device(99)


def test_importing_the_library_imports_no_triton() -> None:
    program = "import sys, ultragray; ultragray.render; sys.exit('triton' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


COMPILE = """
import re, subprocess, sys
from pathlib import Path
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from ultragray.cuda import launch as l
from ultragray.cuda.kernels import drawing, gathering, placing, slicing

capability, how = int(sys.argv[1]), l.GPU_SHAPES
INTEGERS = {"count", "shn_stride", "height", "width", "blocks", "poses", "keep"}
TYPES = {"pitch": "fp32", "row_cm": "fp32", "views": "*fp64"}
TYPES |= dict.fromkeys(("rectangles", "bounds", "counts", "places"), "*i32")

def compile(kernel, warps, **constants):
    types = {}
    for name in kernel.arg_names:
        flag = name.startswith(("wants_", "has_")) or name in INTEGERS
        types[name] = "constexpr" if name in constants else "i32" if flag else TYPES.get(name, "*fp32")
    values = {(kernel.arg_names.index(name),): value for name, value in constants.items()}
    source = ASTSource(kernel, types, values)
    options = {"num_warps": warps}
    made = triton.compile(source, target=GPUTarget("cuda", capability, 32), options=options)
    cubin = Path(sys.argv[2], "kernel.cubin")
    cubin.write_bytes(made.asm["cubin"])
    tool = Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"
    usage = subprocess.run([tool, "-res-usage", cubin], capture_output=True, text=True, check=True).stdout
    print(kernel.__name__, *re.findall(r"(?:REG|LOCAL|SHARED):\\d+", usage))

for convex in (False, True):
    compile(slicing.slice_gaussians, 4, CONVEX=convex, SIGMOID=convex, DEGREE=1, RECORD=convex, BLOCK=how.block)
    compile(
        drawing.draw_tiles, how.draw_warps, CONVEX=convex, BLOCK=how.block, S_LANES=how.slices_at_once,
        TILE_ROWS=how.tile_rows, TILE_COLUMNS=how.tile_columns, CHUNK=how.chunk,
    )
    compile(
        gathering.gather_slices, 1, CONVEX=convex, BLOCK=how.block, S_LANES=how.slices_at_once,
        ROWS=how.gather_rows, COLUMNS=how.gather_columns,
    )
    compile(placing.place_gradients, 4, CONVEX=convex, SIGMOID=convex, DEGREE=1, TERMS=4, BLOCK=how.block)
compile(drawing.finish_frames, 4, TILE_ROWS=how.tile_rows, COLUMNS=how.finish_columns)
compile(gathering.differentiate_pixels, 4, ROWS=how.pixel_rows, COLUMNS=how.pixel_columns)
"""


@pytest.mark.parametrize("capability", [80, 90])
def test_the_kernels_compile_for_gpus_and_keep_to_their_registers(capability: int, tmp_path: Any) -> None:
    """Triton's compiler needs no GPU; the interpreter alone would not see a type that changes within a loop."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    environment["TRITON_CACHE_DIR"] = str(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", COMPILE, str(capability), str(tmp_path)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    used = [line.split() for line in done.stdout.splitlines()]
    assert len(used) == 10
    for name, *resources in used:
        found = {kind: int(number) for kind, number in (resource.split(":") for resource in resources)}
        assert found["LOCAL"] == 0, f"{name} spills registers"
        assert found["REG"] <= 168, f"{name} takes {found['REG']} registers"


def test_work_is_counted_from_real_slices(on_device: Callable[..., GaussianScene]) -> None:
    one = GaussianScene.from_splats(
        {
            "means": torch.tensor([[0.0, 0.0, 2.5], [0.0, 2.0, 2.5]]),  # the second is out of the plane
            "scales": torch.full((2, 3), -3.0),
            "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2),
            "transmittances": torch.full((2,), 30.0),
            "sh0": torch.zeros(2, 1, 1),
        }
    )
    scene = on_device(one)
    work = count_work(scene, LINEAR, scene.poses_to_scene_cm(np.eye(4)[None]), 512, 512)
    assert work.gaussians == 2
    assert work.slices == 1
    # e^-3 cm = 0.498 mm: 3.33 deviations to all sides at 12.8 columns and 10.24 rows a millimetre, 4.9 below
    assert 42 * (16 + 24) < work.footprint_pixels < 46 * (19 + 29)
    assert work.tile_visits >= work.footprint_pixels / (launch.shapes().tile_rows * launch.shapes().tile_columns)
    assert work.bytes_read > 2 * 40 + 3 * 4 * 512 * 512


@pytest.mark.gpu
def test_a_cuda_graph_replays_frames_of_other_poses(scene: GaussianScene, random_poses: Any) -> None:
    """Nothing between poses and frames waits for the device."""
    poses = random_poses(2)
    geometry = launch.Geometry.of(LINEAR, SIZE["height"], SIZE["width"])
    tables = [
        torch.from_numpy(launch.view_table(LINEAR, scene.poses_to_scene_cm(pose[None]), SIZE["height"])).cuda()
        for pose in poses
    ]
    gaussians, views = frames.sorted_gaussians(scene), tables[0].clone()

    def shoot() -> torch.Tensor:
        return launch.draw(launch.cut(gaussians, views, geometry, record=False), geometry, ("bmode",), keep=False)[0][
            "bmode"
        ]

    shoot()  # compiles
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        bmode = shoot()
    for table, pose in zip(tables, poses, strict=True):
        views.copy_(table)
        graph.replay()
        np.testing.assert_array_equal(bmode.cpu().numpy(), planes(scene, LINEAR, pose[None])[0].astype(np.float32))


@pytest.mark.gpu
def test_rendering_never_waits_for_the_device(scene: GaussianScene, random_poses: Any) -> None:
    poses = random_poses(3)
    planes(scene, LINEAR, poses)  # compiles, sorts
    torch.cuda.set_sync_debug_mode("error")
    try:
        render(scene, LINEAR, poses, backend="cuda", **SIZE)
    finally:
        torch.cuda.set_sync_debug_mode("default")
