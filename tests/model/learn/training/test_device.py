"""Which device a training takes, and what is said where that cannot be."""

import pytest
import torch

from ultragray.errors import BackendUnavailable
from ultragray.learn.training.memory import training_device


@pytest.fixture
def one_gpu(monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)


@pytest.fixture
def no_gpu(monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


@pytest.mark.parametrize("backend", ["auto", "cuda", "reference"])
@pytest.mark.usefixtures("one_gpu")
def test_gpus_by_number(backend):
    assert training_device("cuda", backend) == torch.device("cuda", 0)
    assert training_device("cuda:0", backend) == torch.device("cuda", 0)
    with pytest.raises(BackendUnavailable, match="CUDA device 7 was asked for, but there are 1"):
        training_device("cuda:7", backend)


@pytest.mark.usefixtures("one_gpu")
def test_a_backend_that_renders_elsewhere_is_refused():
    with pytest.raises(
        BackendUnavailable, match="backend cuda renders on a GPU, but the device is cpu: give device cu"
    ):
        training_device("cpu", "cuda")
    with pytest.raises(BackendUnavailable, match="backend cpu renders on the CPU, but the device is cuda:0: give devi"):
        training_device("cuda:0", "cpu")


@pytest.mark.usefixtures("no_gpu")
def test_says_what_is_missing_without_a_gpu():
    for device, backend in (("cuda", "auto"), ("cuda:7", "auto"), ("cpu", "cuda"), ("cuda", "cpu")):
        with pytest.raises(BackendUnavailable, match="backend cuda needs an NVIDIA GPU and torch's CUDA build, but"):
            training_device(device, backend)
    assert training_device("cpu", "auto") == torch.device("cpu")


@pytest.mark.usefixtures("one_gpu")
@pytest.mark.parametrize("name", ["", "warp", "cuda:", "cuda:x", "cuda:-1", "cuda:²", "cudaX", "cpu:1", "meta", "mps"])
def test_other_names_are_refused(name):
    with pytest.raises(BackendUnavailable, match="device must be cpu, cuda or cuda:N, got"):
        training_device(name, "auto")


def test_kernels_that_are_interpreted_train_on_the_cpu(monkeypatch):
    pytest.importorskip("triton")
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    assert training_device("cuda", "cuda") == torch.device("cpu") == training_device("cpu", "cuda")
