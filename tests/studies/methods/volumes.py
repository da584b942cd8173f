"""Volumes that are known everywhere, sweeps through them, and budgets of a number of steps, for tests of fields."""

import numpy as np
import torch

from ultragray import LinearProbe
from ultragray.learn.sweep import Dataset, Sweep
from ultragray_studies.methods.method import Budget, Pace, Paces
from ultragray_studies.methods.parts import pixel_points_mm

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
