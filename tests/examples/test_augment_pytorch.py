"""The dataset of simulated frames behind loaders of any number of workers."""

import subprocess
import sys

import pytest
import torch

from .conftest import EXAMPLES


@pytest.fixture(scope="module")
def augment(load_example):
    return load_example("augment_pytorch")


def test_an_epoch_is_the_same_whoever_loads_it(augment, demo_service):
    frames = augment.SimulatedFrames(demo_service.grpc, "demo", 5, labels=False, seed=3)
    first, again = list(frames), list(frames)
    assert len(first) == 5
    for one, other in zip(first, again, strict=True):
        assert one["bmode"].shape == (1, 256, 256)
        assert one["bmode"].dtype == torch.float32
        assert 0.1 < float(one["bmode"].max()) <= 1.0
        assert torch.equal(one["bmode"], other["bmode"])
    assert not torch.equal(first[0]["pose"], first[1]["pose"])
    frames.epoch = 1
    assert not torch.equal(next(iter(frames))["pose"], first[0]["pose"])


def test_labels_come_along_if_asked_for(augment, demo_service):
    sample = next(iter(augment.SimulatedFrames(demo_service.grpc, "demo", 1, labels=True, seed=0)))
    assert sample["labels"].shape == (256, 256)
    assert sample["labels"].dtype == torch.int64
    assert set(sample["labels"].unique().tolist()) <= {0, 1, 2, 3, 4}


@pytest.mark.long
@pytest.mark.parametrize("workers", ["0", pytest.param("2", marks=pytest.mark.long)])
def test_as_a_program(demo_service, workers):
    command = [sys.executable, EXAMPLES / "augment_pytorch.py", "--address", demo_service.grpc]
    options = ["--frames", "24", "--batch-size", "8", "--workers", workers]
    told = subprocess.run([*command, *options], check=True, capture_output=True, text=True, timeout=120).stdout
    assert "bmode [8, 1, 256, 256], pose [8, 4, 4]" in told
    assert "24 frames" in told
