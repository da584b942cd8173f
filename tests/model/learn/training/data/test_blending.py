"""Planes between two frames, blended in space: as the baseline `linear` predicts them."""

import numpy as np
import pytest
import torch

from ultragray.geometry.pose import pose_from_position_quaternion
from ultragray.geometry.probe import ConvexProbe, LinearProbe, PhasedProbe, RadialProbe, SteeredProbe
from ultragray.learn.evaluation.baselines import interpolate_planes
from ultragray.learn.sweep import Sweep
from ultragray.learn.training.between import blend_in_space

SIZE = 48
PROBES = (
    LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=30.0),
    SteeredProbe(width_mm=40.0, steering_deg=15.0, near_mm=0.0, far_mm=30.0),
    ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=90.0),
    PhasedProbe(opening_angle_deg=80.0, far_mm=80.0),
    RadialProbe(near_mm=1.0, far_mm=30.0),
)


def two_frames(probe, apart_mm=4.0):
    """Smooth frames that close in themselves from right to left, the second one moved and turned within its plane."""
    rows, columns = np.meshgrid(np.arange(SIZE), np.arange(SIZE), indexing="ij")
    waves = [np.sin(rows / 5 + phase) + np.cos(2 * np.pi * columns / SIZE + phase) for phase in (0.0, 1.0)]
    turn = np.radians(6.0)
    moved = pose_from_position_quaternion([1.5, apart_mm, -1.0], [np.cos(turn / 2), 0.0, np.sin(turn / 2), 0.0])
    images = np.stack([np.round(127 + 60 * wave) for wave in waves]).astype(np.uint8)
    return Sweep(images, np.stack([np.eye(4), moved]), probe, np.arange(2), "two frames")


def between(*heights_mm):  # [V, 4, 4] mm
    poses = np.tile(np.eye(4), (len(heights_mm), 1, 1))
    poses[:, 1, 3] = heights_mm
    poses[:, 0, 3] = 0.3
    return poses


def blended(sweep, poses):
    sides = (torch.from_numpy(sweep.images).float() / 255.0).expand(len(poses), -1, -1, -1)
    return blend_in_space(sides, np.stack([sweep.poses] * len(poses)), poses, sweep.probe).images.numpy()


@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.kind)
def test_planes_between_two_frames_are_those_of_the_baseline(probe):
    sweep, poses = two_frames(probe), between(0.5, 2.0, 3.0)
    expected = interpolate_planes(sweep, poses)
    errors = np.abs(blended(sweep, poses) - expected)
    assert expected.std() > 0.1
    assert np.quantile(errors, 0.99) < 2e-3  # at the outline, pixels may fall inside here and outside there
    assert np.quantile(np.abs(expected - expected.mean()), 0.5) > 0.05


def test_a_plane_that_is_a_frame_shows_that_frame():
    sweep = two_frames(PROBES[0])
    assert np.allclose(blended(sweep, sweep.poses), sweep.images / 255.0, atol=1e-4)


def test_what_no_frame_shows_is_black_and_what_one_shows_is_its():
    sweep = two_frames(PROBES[0])
    aside = between(2.0, 2.0)
    aside[:, 0, 3] = [100.0, 25.0]
    far, near = blended(sweep, aside)
    assert far.max() == 0.0
    assert near[:, -SIZE // 4 :].max() == 0.0
    assert near[:, : SIZE // 4].min() > 0.0
