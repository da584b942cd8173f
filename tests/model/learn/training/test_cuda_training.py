"""Training on the CUDA backend: what the CPU learns, resumed and repeated bit for bit."""

import json
from dataclasses import replace

import numpy as np
import pytest

from ultragray.learn.training import TrainingConfig, train
from ultragray.rendering.backends import cuda


@pytest.fixture
def dataset(tiny_dataset):
    return tiny_dataset(frames=5, height=16, width=12)


@pytest.fixture
def config(tiny_config):
    if not cuda.available():
        pytest.skip("there is no GPU, and Triton is not installed, which could interpret the kernels")
    return tiny_config(steps=6, max_gaussians=30, batch_size=2, refinements=1)


def learned(dataset, config, device, backend):
    seen = []
    return train(dataset, config, report=seen.append, device=device, backend=backend), seen


@pytest.mark.long
@pytest.mark.slow
def test_learns_what_the_cpu_learns(dataset, config):
    config = replace(config, refinements=0)  # whose random halves turn with quaternions that nothing decides yet
    expected, by_cpu = learned(dataset, config, "cpu", "cpu")
    found, by_cuda = learned(dataset, config, "cuda", "cuda")
    assert [state.loss for state in by_cuda] == pytest.approx([state.loss for state in by_cpu], rel=1e-4)
    assert [state.gaussian_count for state in by_cuda] == [state.gaussian_count for state in by_cpu]
    assert found.info.metrics == pytest.approx(expected.info.metrics, abs=1e-2)
    assert by_cuda[-1].val_psnr_db == pytest.approx(found.info.metrics["psnr_db"], abs=1e-3)
    assert (by_cuda[-1].peak_memory_mb is None) == cuda.interpreted()
    assert {tensor.device.type for tensor in found.splats.values()} == {"cpu"}


@pytest.mark.long
def test_a_resumed_run_on_cuda_ends_in_the_same_scene(dataset, config, tmp_path):
    expected = train(dataset, config, device="cuda", backend="cuda").to_bytes()
    steps = iter(range(100))
    for resume in (False, True):
        scene = train(
            dataset,
            config,
            folder=tmp_path,
            resume=resume,
            should_stop=lambda: next(steps) == 2,  # before the refinement
            device="cuda",
            backend="cuda",
        )
    assert scene.to_bytes() == expected
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == list(range(1, 7))
    assert all(("peak_memory_mb" in line) != cuda.interpreted() for line in lines)


@pytest.mark.gpu
def test_a_gpu_reaches_what_the_cpu_reaches(tiny_dataset):
    dataset = tiny_dataset(frames=40, height=96, width=80, spacing_mm=0.2)
    config = TrainingConfig.preset("fast", steps=250, max_gaussians=2_000, refinements=2)
    by_cpu, by_gpu = (learned(dataset, config, device, "auto") for device in ("cpu", "cuda"))
    assert by_gpu[0].info.metrics["psnr_db"] == pytest.approx(by_cpu[0].info.metrics["psnr_db"], abs=0.3)
    assert by_gpu[1][-1].peak_memory_mb is not None
    np.testing.assert_allclose(
        [state.loss for state in by_gpu[1][:10]], [state.loss for state in by_cpu[1][:10]], rtol=1e-3
    )
