"""The pool with the CUDA backend: its kernels through Triton's interpreter, its failures as torch tells them."""

import asyncio
import importlib.util
import os
import signal
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, render
from ultragray.errors import BackendUnavailable, MemoryExceeded
from ultragray.rendering.settings import Encoding
from ultragray_workers import PoolConfig, RenderPool, SceneStore

from ..asking import asking

TOLERANCE = 5e-4  # of the CUDA backend against the others

needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="the package triton is not installed: no kernels to interpret"
)
needs_no_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="is about machines without a CUDA device")
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")

WHERE = [  # TRITON_INTERPRET, and what frames say rendered them
    pytest.param("1", "cuda-interpreted", marks=needs_triton, id="interpreted"),
    pytest.param("0", "cuda-sm", marks=[pytest.mark.gpu, needs_gpu], id="gpu"),
]


@pytest.mark.parametrize(("interpret", "renderer"), WHERE)
def test_frames_are_what_the_cpu_renders(
    run, open_pool, random_scene, random_poses, scene_folder, monkeypatch, interpret, renderer
):
    convex = ConvexProbe(opening_angle_deg=60.0, near_mm=5.0, far_mm=40.0)
    scene = random_scene(20, sigma_cm=(0.1, 0.4), info={"image_height": 24, "image_width": 32})
    scene.save(scene_folder / "tiny.ugr")
    request = asking("tiny", random_poses(3), probe=convex, outputs=("bmode", "transmittance"))
    requests = [
        replace(request, settings=replace(request.settings, encoding=encoding))
        for encoding in (Encoding.FLOAT32, Encoding.UINT8)
    ]

    async def main():
        async with open_pool(backend="cuda", max_batch_poses=2) as pool:
            await pool.load("tiny")
            results = await asyncio.gather(*(pool.render(request) for request in requests))
            return results, pool.statistics().processes_alive, pool.loaded()

    expected_processes = 1 if interpret == "1" else torch.cuda.device_count()
    monkeypatch.setenv("TRITON_INTERPRET", interpret)
    (floats, bytes_), processes, loaded = run(main())
    assert (processes, loaded) == (expected_processes, {"tiny": expected_processes})
    assert f" {renderer}" in floats.renderer
    assert bytes_.renderer == floats.renderer
    direct = render(scene, convex, request.poses, height=24, width=32, outputs=request.settings.outputs, backend="cpu")
    expected = np.stack([getattr(direct, name).numpy() for name in request.settings.outputs])
    assert expected[0].max() > 0.1  # there is something to see
    np.testing.assert_allclose(np.frombuffer(floats.data, "<f4").reshape(expected.shape), expected, atol=TOLERANCE)
    grey = np.frombuffer(bytes_.data, np.uint8).reshape(expected.shape).astype(float)
    assert np.abs(grey - np.round(255 * expected)).max() <= 1


@needs_no_gpu
async def test_no_gpu_is_one_clear_error_and_no_process(scene_folder, processes, monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    with pytest.raises(BackendUnavailable, match="needs an NVIDIA GPU"):
        await RenderPool(SceneStore(scene_folder), PoolConfig(backend="cuda")).start()
    assert processes() == {}


@pytest.fixture
def patch_workers(cold_templates, tmp_path, monkeypatch):
    """Runs code in each template before it forks workers: what only a GPU would do to them."""

    def patch(code):
        folder = tmp_path / "patches"
        folder.mkdir()
        imports = "import torch\nfrom ultragray_workers.pool import worker"
        (folder / "sitecustomize.py").write_text(f"{imports}\n{code}")
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), *filter(None, sys.path)]))

    return patch


THREE_GPUS = """
import pathlib
hello = worker.Hello
worker.Hello = lambda pid, gpus=0, error=None: hello(pid, 3, error)

def take(backend, number):
    pathlib.Path({folder!r}, str(number)).touch()
    return torch.device("cpu")

worker.render_device = take
"""


@pytest.mark.long
@pytest.mark.parametrize(("asked", "expected"), [(0, 3), (1, 1), (4, 4)])
async def test_each_gpu_gets_a_process_where_no_number_is_given(open_pool, patch_workers, tmp_path, asked, expected):
    (tmp_path / "taken").mkdir()
    patch_workers(THREE_GPUS.format(folder=str(tmp_path / "taken")))
    async with open_pool(processes=asked) as pool:
        await pool.load("a")
        statistics, loaded = pool.statistics(), pool.loaded()
    assert (statistics.processes_alive, loaded) == (expected, {"a": expected})
    assert {file.name for file in (tmp_path / "taken").iterdir()} == {str(number) for number in range(expected)}


OUT_OF_MEMORY = """
render = worker.render_shown

def render_few(scene, settings, poses, **options):
    if len(poses) * settings.height > 60:
        raise torch.OutOfMemoryError("CUDA out of memory")
    return render(scene, settings, poses, **options)

worker.render_shown = render_few
"""


@pytest.mark.usefixtures("batches_of_any_length")
async def test_out_of_memory_fails_the_request_and_no_more(
    open_pool, random_poses, expect_frames, until, patch_workers
):
    patch_workers(OUT_OF_MEMORY)
    large = asking("a", random_poses(1), height=61, outputs=("bmode", "echo"))
    alike = [asking("a", random_poses(2, seed=seed)) for seed in range(2)]  # too many together
    async with open_pool() as pool:
        with pytest.raises(MemoryExceeded, match=r"1 frames of 61x32 pixels \(bmode, echo\)"):
            await pool.render(large)
        (worker,) = pool.statistics().pids
        os.kill(worker, signal.SIGSTOP)
        first = asyncio.create_task(pool.render(asking("b", random_poses(1))))
        await until(lambda: pool.statistics().busy == 1)
        tasks = [asyncio.create_task(pool.render(request)) for request in alike]
        await until(lambda: pool.statistics().waiting_frames == 4)
        os.kill(worker, signal.SIGCONT)
        await first
        results = [await task for task in tasks]
        assert pool.statistics().restarts_total == 0
        found = results
    for request, result in zip(alike, found, strict=True):
        assert result.batch_size > 2  # more than fit together: each was rendered again alone
        expect_frames(request, result)


FULL_GPU = """
render = worker.render_shown

def render_in_little(scene, settings, poses, **options):
    torch.cuda.empty_cache()
    torch.cuda.set_per_process_memory_fraction(0.0 if settings.height > 60 else 1.0)
    return render(scene, settings, poses, **options)

worker.render_shown = render_in_little
"""


@pytest.mark.gpu
@needs_gpu
async def test_a_full_gpu_fails_the_request_and_no_more(open_pool, random_poses, patch_workers, monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    patch_workers(FULL_GPU)
    async with open_pool(backend="cuda", processes=1) as pool:
        await pool.render(asking("a", random_poses(1)))
        with pytest.raises(MemoryExceeded, match="1200"):
            await pool.render(asking("a", random_poses(1), height=1200, width=1000))
        await pool.render(asking("a", random_poses(1)))
        assert pool.statistics().restarts_total == 0


LOST_GPU = """
import pathlib
render = worker.render_shown

def lose(*_):
    raise RuntimeError("CUDA error: an illegal memory access was encountered")

def lose_once(scene, *arguments, **options):
    if scene.gaussian_count == 50 and pathlib.Path({lost!r}).exists():
        pathlib.Path({lost!r}).unlink()
        torch.cuda.is_initialized, torch.cuda.synchronize = lambda: True, lose
        lose()
    return render(scene, *arguments, **options)

worker.render_shown = lose_once
"""


async def test_a_worker_that_lost_its_gpu_is_replaced_and_the_work_done_again(
    open_pool, random_poses, expect_frames, tmp_path, patch_workers
):
    """After an error of a kernel nothing works any more in the process that it belonged to."""
    lost = tmp_path / "lost"
    lost.touch()
    patch_workers(LOST_GPU.format(lost=str(lost)))
    request = asking("a", random_poses(2))
    async with open_pool() as pool:
        result = await pool.render(request)
        assert pool.statistics().restarts_total == 1
        found = result
    expect_frames(request, found)
