"""A small sweep, and a method of a moment, for tests of what all methods share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import nn

from ultragray import LinearProbe
from ultragray.learn.sweep import Dataset, Sweep
from ultragray_studies.methods.learner import LearnedMethod, Learner
from ultragray_studies.methods.method import Description

SIDE = 32
PROBE = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=20.0)


class _Image(Learner):
    """The mean of the frames, learned pixel by pixel with a little noise, so that the generator matters."""

    def __init__(self, dataset, seed, device):
        super().__init__(dataset, seed, device)
        start = torch.rand(self.images.shape[1:], generator=self.generator)
        self.module = nn.ParameterDict({"image": nn.Parameter(start.to(device))})
        self.optimizers = {"adam": torch.optim.Adam(self.module.parameters(), lr=0.05)}

    def loss(self, step, steps):
        place = int(torch.randint(len(self.images), (), generator=self.generator))
        noise = 0.01 * torch.rand(self.images.shape[1:], generator=self.generator)
        return (self.module["image"] + noise - self.image(place)).square().mean()

    def frame(self, probe, pose, height, width):
        return self.module["image"]


@dataclass(frozen=True)
class MeanImage(LearnedMethod):
    """Shows the same frame from everywhere."""

    name: str = "mean-image"

    def describe(self):
        return Description("Mean image", "these tests", "One image for all poses.", published_steps=200)

    def learner(self, dataset, budget, seed, device):
        return _Image(dataset, seed, device)


@pytest.fixture
def mean_image():
    return MeanImage()


@pytest.fixture
def make_dataset():
    """A sweep along elevation through a ball in grey noise; every fourth frame is held out."""

    def make(frames=8, side=SIDE):
        poses = np.tile(np.eye(4), (frames, 1, 1))
        poses[:, 1, 3] = 0.8 * np.arange(frames)
        x, z = np.meshgrid(np.linspace(-1, 1, side), np.linspace(0, 1, side))
        ball = 140.0 * np.exp(-((x - 0.1) ** 2 + (z - 0.4) ** 2) / 0.1)
        noise = np.random.default_rng(0).normal(50.0, 4.0, (frames, side, side))
        images = np.clip(ball + noise, 0, 255).astype(np.uint8)
        held_out = np.arange(frames) % 4 == 2

        def part(chosen):
            return Sweep(images[chosen], poses[chosen], PROBE, np.arange(frames)[chosen], "tiny")

        return Dataset("tiny", part(~held_out), part(held_out))

    return make
