"""A sweep that moves and turns, small enough to study in a second."""

import math

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.datasets import Dataset, Sweep
from ultragray.learn.training import TrainingConfig

FRAMES, HEIGHT, WIDTH = 12, 20, 16
LARGEST_TILT_DEG = 10.0


@pytest.fixture
def turning_dataset():
    """A ball in noise under a probe that turns from −10° to +10° about its lateral axis; every fourth is held out."""
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    angles = np.radians(np.linspace(-LARGEST_TILT_DEG, LARGEST_TILT_DEG, FRAMES))
    for pose, angle in zip(poses, angles, strict=True):
        c, s = math.cos(angle), math.sin(angle)
        pose[1:3, 1:3] = [[c, -s], [s, c]]
    x, z = np.meshgrid(np.linspace(-1, 1, WIDTH), np.linspace(0, 1, HEIGHT))
    ball = 140.0 * np.exp(-((x - angles[:, None, None]) ** 2 + (z - 0.4) ** 2) / 0.1)
    noise = np.random.default_rng(0).normal(50.0, 4.0, (FRAMES, HEIGHT, WIDTH))
    images = np.clip(ball + noise, 0, 255).astype(np.uint8)
    sweep = Sweep(images, poses, LinearProbe(20.0, 0.0, 25.0), np.arange(FRAMES), "turning")
    held_out = np.arange(FRAMES) % 4 == 1
    return Dataset("turning <sweep>", sweep.select(np.flatnonzero(~held_out)), sweep.select(np.flatnonzero(held_out)))


@pytest.fixture
def small_config():
    return TrainingConfig.preset("fast", steps=6, max_gaussians=60, batch_size=3)
