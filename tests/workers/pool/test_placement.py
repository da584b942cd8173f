"""Where scenes are put."""

import pytest
import torch

from ultragray.errors import BackendUnavailable
from ultragray.rendering.backends import cuda
from ultragray.rendering.backends.registry import render_device

CPU = torch.device("cpu")


@pytest.fixture
def two_gpus(monkeypatch):
    monkeypatch.setattr(cuda, "available", lambda: True)
    monkeypatch.setattr(cuda, "device_count", lambda: 2)
    monkeypatch.setattr(cuda, "device", lambda index: torch.device("cuda", index))


@pytest.mark.parametrize("backend", ["auto", "cuda"])
def test_processes_take_the_gpus_in_turn(two_gpus, backend):
    assert [render_device(backend, number).index for number in range(5)] == [0, 1, 0, 1, 0]


@pytest.mark.parametrize("backend", ["cpu", "reference", "nonsense"])
def test_other_backends_stay_on_the_cpu(two_gpus, backend):
    assert render_device(backend, 1) == CPU


def test_without_a_gpu_auto_stays_on_the_cpu_and_cuda_is_refused(monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    assert render_device("auto") == CPU
    with pytest.raises(BackendUnavailable, match="needs an NVIDIA GPU"):
        render_device("cuda")
