"""A training that would not fit is refused before it starts."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from ultragray.datasets.sweep import Dataset
from ultragray.errors import MemoryExceeded
from ultragray.training import TrainingConfig, memory, train


def test_names_what_to_lower(tiny_dataset: Callable[..., Dataset]) -> None:
    config = TrainingConfig.preset("fast", max_gaussians=50_000_000, memory_gb=4.0)
    with pytest.raises(MemoryExceeded, match=r"50,000,000 Gaussians .* memory_gb allows 4\.0 GiB: lower max_gaussians"):
        train(tiny_dataset(), config)


def test_uses_what_is_free(tiny_dataset: Callable[..., Dataset], monkeypatch: pytest.MonkeyPatch) -> None:
    dataset, config = tiny_dataset(), TrainingConfig(max_gaussians=1000)
    needed = memory.required_bytes(dataset, config)
    monkeypatch.setattr(memory, "available_bytes", lambda: needed)
    memory.check_memory(dataset, config)
    monkeypatch.setattr(memory, "available_bytes", lambda: needed - 1)
    with pytest.raises(MemoryExceeded, match="this machine has free"):
        memory.check_memory(dataset, config)


def test_grows_with_gaussians_and_pixels(tiny_dataset: Callable[..., Dataset]) -> None:
    def needed(dataset: Dataset, **settings: int) -> int:
        return memory.required_bytes(dataset, TrainingConfig.preset("fast", **{"max_gaussians": 1000, **settings}))

    small = tiny_dataset()
    per_gaussian = (needed(small, max_gaussians=200_000) - needed(small, max_gaussians=100_000)) / 100_000
    assert 4 * 15 * 5 < per_gaussian < 2_000  # parameters, gradients, moments and a copy at least
    assert needed(tiny_dataset(height=200, width=200)) > needed(small)
    assert needed(small, sh_degree=3) > needed(small)


def test_finds_out_what_is_available() -> None:
    available = memory.available_bytes()
    assert available is None or available > 0


PROGRAM = """
import sys; sys.path[:0] = {path!r}
import importlib.util, pathlib, resource, torch
spec = importlib.util.spec_from_file_location("tiny", {conftest!r})
tiny = importlib.util.module_from_spec(spec); spec.loader.exec_module(tiny)
from ultragray.training import memory, train
torch.set_num_threads(1)
dataset = tiny.make_tiny_dataset(height=64, width=64)
config = tiny.make_tiny_config(max_gaussians=200_000, steps=3, refinements=1)
train(dataset, config, folder=pathlib.Path({folder!r}), checkpoint_interval_s=0.0)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024, memory.required_bytes(dataset, config))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in KiB only on Linux")
def test_what_is_said_is_an_upper_bound(tmp_path: Path) -> None:
    conftest = str(Path(__file__).with_name("conftest.py"))
    program = PROGRAM.format(path=sys.path, conftest=conftest, folder=str(tmp_path))
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    found = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True, env=environment)
    used, said = map(int, found.stdout.split())
    assert 0.5 * said < used < said
