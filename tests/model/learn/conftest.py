"""A sweep small enough to train from in a second."""

import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe
from ultragray.datasets import checks
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.agreement import agreed_path

LINEAR = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=25.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=60.0)


def make_tiny_dataset(*, frames=10, height=20, width=16, spacing_mm=0.8, probe=LINEAR):
    """A bright ball in grey noise, seen by a probe that moves along elevation; every fourth frame is held out."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, 3] = (30.0, -20.0, 10.0)
    poses[:, 1, 3] += spacing_mm * np.arange(frames)
    x, z = np.meshgrid(np.linspace(-1, 1, width), np.linspace(0, 1, height))
    y = np.linspace(-1, 1, frames)[:, None, None]
    ball = np.exp(-((x - 0.3 * y) ** 2 + (z - 0.4) ** 2 + 0.2 * y**2) / 0.1)
    noise = np.random.default_rng(0).normal(0.0, 4.0, (frames, height, width))
    images = np.clip(140.0 * ball + 50.0 + noise, 0, 255).astype(np.uint8)
    numbers = np.arange(frames)
    held_out = numbers % 4 == 2

    def part(chosen):
        return Sweep(images[chosen], poses[chosen], probe, numbers[chosen], "tiny")

    return Dataset("tiny", part(~held_out), part(held_out))


def make_tiny_config(**settings):
    values = {"steps": 24, "max_gaussians": 60, "batch_size": 3, "sh_start": 0.25, "refinements": 3}
    return TrainingConfig.preset("fast", **{**values, "confidence": False, **settings})


@pytest.fixture
def tiny_dataset():
    return make_tiny_dataset


@pytest.fixture
def tiny_config():
    return make_tiny_config


@pytest.fixture(params=[LINEAR, CONVEX], ids=["linear", "convex"])
def probe(request):
    return request.param


@pytest.fixture
def found_paths(monkeypatch):
    """Those that a check found."""
    paths = []
    monkeypatch.setattr(checks, "agreed_path", lambda dataset: paths.append(agreed_path(dataset)) or paths[-1])
    return paths
