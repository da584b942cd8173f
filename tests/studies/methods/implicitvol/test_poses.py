"""Refined poses: the tracker's at first, angles and translations that mean what they say, and the common motion."""

import math

import numpy as np
import pytest
import torch

from ultragray.learn.sweep import mean_axes
from ultragray_studies.methods.implicitvol import FramePoses, angles_of, rotation_of
from ultragray_studies.methods.parts import pixel_points_mm

from ..volumes import PROBE, along_elevation, seen

CPU = torch.device("cpu")
HALF_HEIGHT_MM = 12.5
QUARTER = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # 90° about y: where Rz Ry Rx is singular


def turned_sweep():
    """Poses that all lie near a quarter turn about y, their refinement, and the scene's centre."""
    poses = along_elevation(np.arange(4) * 1.5)
    for place, pose in enumerate(poses):
        pose[:3, :3] = QUARTER @ rotation_of(torch.tensor([0.02, -0.05, 0.1]).double() * place).numpy()
    dataset = seen(poses, (10, 8))
    return poses, FramePoses(dataset.train, dataset.centre_mm, HALF_HEIGHT_MM, CPU), dataset.centre_mm


def test_a_rotation_is_about_x_then_y_then_z():
    def about(axis, angle):
        angles = torch.zeros(3)
        angles[axis] = angle
        return rotation_of(angles)

    torch.testing.assert_close(about(2, math.pi / 2) @ torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]))
    torch.testing.assert_close(about(0, math.pi / 2) @ torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.0, 1.0]))
    torch.testing.assert_close(about(1, math.pi / 2) @ torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0]))
    together = about(2, 0.3) @ about(1, -0.4) @ about(0, 0.5)
    torch.testing.assert_close(rotation_of(torch.tensor([0.5, -0.4, 0.3])), together)


def test_angles_are_those_of_the_rotation():
    angles = np.array([[0.5, -0.4, 0.3], [-2.0, 1.0, 3.0]])
    rotations = np.stack([rotation_of(torch.from_numpy(one)).numpy() for one in angles])
    np.testing.assert_allclose(angles_of(rotations), angles, atol=1e-12)


def test_frames_begin_where_the_tracker_saw_them_near_a_quarter_turn_too():
    poses, refined, centre_mm = turned_sweep()
    pixels_mm = torch.from_numpy(pixel_points_mm(PROBE, np.eye(4), 10, 8)).float()
    for place, pose in enumerate(poses):
        expected = (pixel_points_mm(PROBE, pose, 10, 8) - centre_mm) / HALF_HEIGHT_MM
        np.testing.assert_allclose(refined.points(place, pixels_mm).detach().numpy(), expected, atol=3e-6)
    assert refined.angles.abs().max() < 0.5


def test_the_common_motion_is_the_one_that_all_frames_made():
    poses, refined, _ = turned_sweep()
    turn = rotation_of(torch.tensor([0.1, 0.2, -0.15]).double()).numpy()
    shift = np.array([0.3, -0.2, 0.1])
    axes = mean_axes(poses)
    with torch.no_grad():
        refined.angles.copy_(torch.from_numpy(angles_of(axes.T @ turn @ poses[:, :3, :3])))
        refined.shifts.copy_(refined.shifts @ torch.from_numpy(turn.T).float() + torch.from_numpy(shift))
        rotation, translation = refined.common_motion()
    np.testing.assert_allclose(rotation.numpy(), turn, atol=1e-5)
    np.testing.assert_allclose(translation.numpy(), shift, atol=1e-5)


def test_frames_of_one_plane_have_a_common_motion_that_is_no_mirror():
    refined = FramePoses(seen(along_elevation(np.zeros(2)), (10, 8)).train, np.zeros(3), HALF_HEIGHT_MM, CPU)
    with torch.no_grad():
        refined.angles += torch.tensor([0.0, 0.0, math.pi])
    rotation, _ = refined.common_motion()
    assert torch.linalg.det(rotation).item() == pytest.approx(1.0, abs=1e-5)
    torch.testing.assert_close(rotation, torch.diag(torch.tensor([-1.0, -1.0, 1.0])), atol=1e-5, rtol=0.0)
