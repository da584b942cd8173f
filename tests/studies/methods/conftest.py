"""A small sweep, and a method of a moment, for tests of what all methods share."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import nn

from ultragray import LinearProbe
from ultragray.learn.sweep import Dataset, Sweep
from ultragray_studies.methods.learner import LearnedMethod, Learner
from ultragray_studies.methods.method import Budget, Description, Pace, Paces
from ultragray_studies.methods.parts import pixel_points_mm

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
        return Description("Mean image", "these tests", "One image for all poses.", published_steps=100)

    def learner(self, dataset, budget, seed, device):
        return _Image(dataset, seed, device)


@pytest.fixture
def mean_image():
    return MeanImage()


@pytest.fixture
def make_dataset():
    return lambda frames=8: make_tiny_dataset(frames=frames, height=SIDE, width=SIDE)


PROBE = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=25.0)


def waves(points_mm):  # [..., 3] -> [...]
    """Grey values between 0.1 and 0.9 that change over some millimetres along every axis."""
    x, y, z = np.moveaxis(points_mm, -1, 0)
    return 0.5 + 0.2 * np.sin(0.7 * x + 0.2 * y) + 0.2 * np.sin(0.6 * z - 0.3 * x + 0.1 * y)


def along_elevation(places_mm):  # [F] -> [F, 4, 4]
    """Poses, far from the tracker's origin, that differ in elevation."""
    poses = np.tile(np.eye(4), (len(places_mm), 1, 1))
    poses[:, :3, 3] = (30.0, -20.0, 10.0)
    poses[:, 1, 3] += places_mm
    return poses


def seen(
    poses,  # [F, 4, 4] mm
    size,
    probe=PROBE,
    volume=waves,
):
    """The volume at the pixels of each frame, with no frame held out."""
    images = np.stack([volume(pixel_points_mm(probe, pose, *size)) for pose in poses])
    sweep = Sweep(np.rint(255.0 * images).astype(np.uint8), poses, probe, np.arange(len(poses)), "waves")
    return Dataset("waves", sweep, sweep.select([]))


def steps_of(method, steps):
    """An equal time that holds just so many steps."""
    paces = Paces()
    paces.get(method.name, lambda: Pace(0.0, 1.0))
    return Budget.equal(steps + 0.5, paces)


def one_frame(height, width):
    """One frame with smooth and sharp parts, twice, as a dataset has two frames at least."""
    poses = along_elevation(np.zeros(2))
    smooth = seen(poses, (height, width))
    images = smooth.train.images.copy()
    images[:, height // 4 : height // 2, width // 4 : width // 2] = 230
    sweep = Sweep(images, poses, PROBE, np.arange(2), "one frame")
    return Dataset("one frame", sweep, sweep.select([]))


def psnr_of_fit(method, dataset, steps):
    """PSNR, dB, of the first training frame as the fitted method renders it."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        fitted = method.fit(dataset, steps_of(method, steps))
    train = dataset.train
    frame = fitted.render(dataset.probe, train.poses[:1], train.height, train.width)[0]
    return float(-10.0 * np.log10(np.square(frame - train.images[0] / 255.0).mean()))
