"""The device of a training; one that would not fit is refused before it starts."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ultragray.errors import BackendUnavailable, MemoryExceeded
from ultragray.learn.training import TrainingConfig, memory, train
from ultragray.learn.training import alignment as overlap
from ultragray.learn.training.geometry import Geometry
from ultragray.learn.training.memory import training_device


def test_names_what_to_lower(tiny_dataset):
    config = TrainingConfig.preset("fast", max_gaussians=50_000_000, memory_gb=4.0)
    with pytest.raises(MemoryExceeded, match=r"50,000,000 Gaussians .* memory_gb allows 4\.0 GiB: lower max_gaussians"):
        train(tiny_dataset(), config)


def test_uses_what_is_free(tiny_dataset, monkeypatch):
    dataset, config = tiny_dataset(), TrainingConfig(max_gaussians=1000)
    needed = memory.required_bytes(dataset, config)
    monkeypatch.setattr(memory, "available_bytes", lambda: needed)
    memory.check_memory(dataset, config, torch.device("cpu"))
    monkeypatch.setattr(memory, "available_bytes", lambda: needed - 1)
    with pytest.raises(MemoryExceeded, match="this machine has free"):
        memory.check_memory(dataset, config, torch.device("cpu"))
    batches = [
        memory.required_bytes(tiny_dataset(height=500, width=500), replace(config, batch_size=size))
        for size in (100, 200)
    ]
    assert np.diff(batches) > 4 * 20 * 100 * 500 * 500, "outputs, and what the backward pass keeps of them"


def test_a_gpu_is_asked_for_its_own_memory(tiny_dataset, monkeypatch):
    dataset, device = tiny_dataset(), torch.device("cuda", 1)
    config = TrainingConfig(max_gaussians=1000)
    needed = memory.required_device_bytes(dataset, config)
    free = {device: needed}
    monkeypatch.setattr(memory, "available_bytes", lambda: 0)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda asked: (free[asked], 1 << 40))
    memory.check_memory(dataset, config, device)
    free[device] = needed - 1
    with pytest.raises(
        MemoryExceeded, match=r"1,000 Gaussians .* cuda:1 has free 0\.3 GiB: lower max_gaussians or batch"
    ):
        memory.check_memory(dataset, config, device)
    with pytest.raises(MemoryExceeded, match=r"cuda:1 has free"):  # a setting allows no more than there is
        memory.check_memory(dataset, TrainingConfig(max_gaussians=1000, memory_gb=64.0), device)
    with pytest.raises(MemoryExceeded, match=r"memory_gb allows 0\.1 GiB"):
        memory.check_memory(dataset, TrainingConfig(max_gaussians=1000, memory_gb=0.1), device)


def test_a_gpu_keeps_a_slice_of_each_gaussian_for_each_frame(tiny_dataset):
    dataset = tiny_dataset(frames=90)

    def needed(batch_size, gaussians):
        return memory.required_device_bytes(dataset, TrainingConfig(max_gaussians=gaussians, batch_size=batch_size))

    per_frame = (needed(64, 500_000) - needed(32, 500_000)) / 32
    assert 500_000 * 4 * 21 < per_frame < 500_000 * 4 * 32
    assert needed(8, 500_000) < 2 << 30  # the training of the paper fits every GPU that is in use


def test_frames_that_cannot_be_compared_are_refused_before_they_are(tiny_dataset, monkeypatch):
    dataset, config = tiny_dataset(), TrainingConfig(max_gaussians=1000)
    monkeypatch.setattr(memory, "available_bytes", lambda: memory.comparison_bytes(dataset, config) - 1)
    monkeypatch.setattr(Geometry, "of", lambda dataset: pytest.fail("the frames were compared"))
    with pytest.raises(MemoryExceeded, match=r"comparing its 8 frames needs up to 0\.0 GiB, this machine has free"):
        train(dataset, config)


def test_the_registration_of_sweeps_takes_a_bounded_share(tiny_dataset, monkeypatch):
    plain, refined = (TrainingConfig(max_gaussians=1000, refine_poses=mode) for mode in ("none", "sweeps"))
    dataset = tiny_dataset(height=500, width=500, frames=8)  # 6 to train from
    assert memory.comparison_bytes(dataset, refined) == memory.REGISTERED_BYTES * 6 * 500**2
    assert memory.comparison_bytes(dataset, plain) < memory.comparison_bytes(dataset, refined)
    monkeypatch.setattr(overlap, "FRAMES", 2)
    assert memory.comparison_bytes(dataset, refined) == memory.REGISTERED_BYTES * 4 * 500**2


@pytest.mark.parametrize(
    ("folder", "limit", "used", "entry"),
    [
        (".", "memory.max", "memory.current", "inactive_file"),
        ("memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ],
)
def test_file_caches_of_a_control_group_are_free(tmp_path, monkeypatch, folder, limit, used, entry):
    group = tmp_path / folder
    group.mkdir(exist_ok=True)
    (group / limit).write_text("1000000\n")
    (group / used).write_text("900000\n")
    (group / "memory.stat").write_text(f"anon 12\n{entry} 600000\nother 7\n")
    monkeypatch.setattr(memory, "CONTROL_GROUPS", tmp_path)
    assert memory.available_bytes() == 700_000
    (group / limit).write_text("max\n")
    available = memory.available_bytes()
    assert available is None or available > 1_000_000


PROGRAM = """
import sys; sys.path[:0] = {path!r}
import importlib.util, pathlib, re, torch
spec = importlib.util.spec_from_file_location("tiny", {conftest!r})
tiny = importlib.util.module_from_spec(spec); spec.loader.exec_module(tiny)
from ultragray.learn.training import memory, train
torch.set_num_threads(1)
dataset = tiny.make_tiny_dataset(**{data!r})
config = tiny.make_tiny_config(steps=3, refinements=1, **{settings!r})
train(dataset, config, folder=pathlib.Path({folder!r}), checkpoint_interval_s=0.0)
peak = re.search(r"VmHWM:\\s+(\\d+) kB", pathlib.Path("/proc/self/status").read_text())
print(int(peak[1]) * 1024, memory.required_bytes(dataset, config))
"""


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="the peak is read from /proc")
@pytest.mark.parametrize(
    ("data", "settings"),
    [
        ({"height": 64, "width": 64}, {"max_gaussians": 200_000}),
        ({"frames": 60, "spacing_mm": 0.005}, {"max_gaussians": 60_000, "batch_size": 64}),  # all are in all planes
        ({"frames": 80, "height": 192, "width": 192}, {"max_gaussians": 1_000}),  # measuring takes the most
    ],
    ids=["gaussians", "slices", "held-out"],
)
def test_what_is_said_is_an_upper_bound(tmp_path, data, settings):
    conftest = str(Path(__file__).parents[1] / "conftest.py")
    program = PROGRAM.format(path=sys.path, conftest=conftest, folder=str(tmp_path), data=data, settings=settings)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    found = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True, env=environment)
    used, said = map(int, found.stdout.split())
    assert 0.5 * said < used < said


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
    assert training_device("cuda", backend) == training_device("cuda:0", backend) == torch.device("cuda", 0)


NO_GPU = "backend cuda needs an NVIDIA GPU and torch's CUDA build, but"
NO_NAME = "device must be cpu, cuda or cuda:N, got"


@pytest.mark.parametrize(
    ("machine", "device", "backend", "told"),
    [
        ("one_gpu", "cuda:7", "auto", "CUDA device 7 was asked for, but there are 1"),
        ("one_gpu", "cpu", "cuda", "backend cuda renders on a GPU, but the device is cpu: give device cu"),
        ("one_gpu", "cuda:0", "cpu", "backend cpu renders on the CPU, but the device is cuda:0: give devi"),
        *(
            ("no_gpu", *asked, NO_GPU)
            for asked in (("cuda", "auto"), ("cuda:7", "auto"), ("cpu", "cuda"), ("cuda", "cpu"))
        ),
        *(
            ("one_gpu", name, "auto", NO_NAME)
            for name in ("", "warp", "cuda:", "cuda:x", "cuda:-1", "cuda:²", "cpu:1", "mps")
        ),
    ],
)
def test_devices_that_cannot_be_are_refused(machine, device, backend, told, request):
    request.getfixturevalue(machine)
    with pytest.raises(BackendUnavailable, match=told):
        training_device(device, backend)


@pytest.mark.usefixtures("no_gpu")
def test_without_a_gpu_the_cpu_is_taken():
    assert training_device("cpu", "auto") == torch.device("cpu")


def test_kernels_that_are_interpreted_train_on_the_cpu(monkeypatch):
    pytest.importorskip("triton")
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    assert training_device("cuda", "cuda") == torch.device("cpu") == training_device("cpu", "cuda")
