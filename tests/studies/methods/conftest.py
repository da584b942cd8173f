"""A small sweep, and a method of a moment, for tests of what all methods share."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from torch import nn

from ultragray_studies.methods.learner import LearnedMethod, Learner
from ultragray_studies.methods.method import Description

from ...model.learn.conftest import make_tiny_dataset

SIDE = 32


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
    return lambda frames=8: make_tiny_dataset(frames=frames, height=SIDE, width=SIDE)
