"""What a fit starts from: where Gaussians lie, how wide they are, the published start."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, LinearProbe
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.training.optimizer import rotate
from ultragray_studies.methods.parts import Box
from ultragray_studies.methods.ultragauss import even_start, wide_start

LINEAR = LinearProbe(width_mm=20.0, near_mm=5.0, far_mm=25.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=60.0)


def sweep_along_elevation(probe):
    """Ten frames, 1 mm apart."""
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, :3, 3] = (30.0, -20.0, 10.0)
    poses[:, 1, 3] += np.arange(10)
    images = np.tile(np.arange(16, dtype=np.uint8), (10, 16, 1))
    frames = Sweep(images, poses, probe, np.arange(10), "made up")
    return Dataset("made up", frames, frames.select([]))


@pytest.mark.parametrize("probe", [LINEAR, CONVEX], ids=["linear", "convex"])
@pytest.mark.parametrize("start", [even_start, wide_start])
def test_means_lie_in_the_space_of_the_frames(start, probe):
    dataset = sweep_along_elevation(probe)
    gaussians = start(dataset, 4_000, torch.Generator().manual_seed(0))
    placed = 10.0 * gaussians["means"].double().numpy() + dataset.centre_mm - (30.0, -20.0, 10.0)
    rows, _ = probe.image_coordinates(placed[:, 0], placed[:, 2])
    assert np.isfinite(rows).mean() > 0.999  # rounding may put one on an edge outside
    assert -0.5001 <= placed[:, 1].min() < -0.4
    assert 9.4 < placed[:, 1].max() <= 9.5001
    depths = np.hypot(placed[:, 0], placed[:, 2]) if probe is CONVEX else placed[:, 2]
    middle = math.sqrt((20.0**2 + 60.0**2) / 2.0) if probe is CONVEX else 15.0  # halves the area of the image
    assert 0.47 < (depths < middle).mean() < 0.53


def test_even_gaussians_are_as_wide_as_their_share_of_the_volume():
    gaussians = even_start(sweep_along_elevation(LINEAR), 500, torch.Generator().manual_seed(0))
    volume_mm3 = 20.0 * 20.0 * 10.0
    assert torch.allclose(10.0 * gaussians["scales"].exp(), torch.tensor((volume_mm3 / 500) ** (1 / 3)))


def test_even_gaussians_reach_over_the_gaps_between_frames_along_the_frames_own_elevation():
    """Ten frames, 1 mm apart, turned by a quarter about the axis of depth: elevation lies along -x of the tracker."""
    dataset = sweep_along_elevation(LINEAR)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    poses = dataset.train.poses.copy()
    poses[:, :3, :3] = turn
    poses[:, :3, 3] = poses[:, :3, 3] @ turn.T
    turned = Dataset("turned", replace(dataset.train, poses=poses), dataset.val)
    gaussians = even_start(turned, 50_000, torch.Generator().manual_seed(0))
    side_mm = (20.0 * 20.0 * 10.0 / 50_000) ** (1 / 3)
    assert torch.allclose(10.0 * gaussians["scales"][0].exp(), torch.tensor([side_mm, 0.5, side_mm]))
    along = rotate(gaussians["quats"][:1], torch.tensor([[0.0, 1.0, 0.0]]))
    assert torch.allclose(along, torch.tensor([[-1.0, 0.0, 0.0]]), atol=1e-6)


def test_the_published_start_has_its_precision():
    """L of entries in [4, 5) in the cube of side 2 around the frames: bounds of each entry of L·Lᵀ follow."""
    dataset = sweep_along_elevation(LINEAR)
    gaussians = wide_start(dataset, 300, torch.Generator().manual_seed(0))
    unit_cm = Box.of(dataset.train).largest_half_mm / 10.0
    axes = torch.stack([rotate(gaussians["quats"], axis.expand(300, 3)) for axis in torch.eye(3)], dim=-1)
    precision = (axes * (gaussians["scales"].exp() / unit_cm).pow(-2)[:, None]) @ axes.transpose(1, 2)
    terms = torch.tensor([[1.0, 1.0, 1.0], [1.0, 2.0, 2.0], [1.0, 2.0, 3.0]])
    assert (precision > 16.0 * terms - 0.1).all()
    assert (precision < 25.0 * terms + 0.1).all()
    assert precision.std(dim=0).min() > 0.5
