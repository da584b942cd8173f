"""Poses: what is accepted, made exact, refused; quaternions; distances."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ultragray import check_poses, pose_from_position_quaternion, quaternion_from_pose
from ultragray.errors import InvalidArgument, InvalidPose
from ultragray.geometry.rotations import rotation_angles_deg


def turned_about_z(degrees):
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0, 1], [s, c, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


def changed(index, value):
    pose = np.eye(4)
    pose[index] = value
    return pose


@pytest.mark.parametrize(
    "given_poses",
    [np.eye(4), np.eye(4)[None], np.eye(4).tolist(), torch.eye(4), np.eye(4, dtype=np.float32), np.eye(4, dtype=int)],
    ids=["one", "batch", "list", "tensor", "float32", "int"],
)
def test_poses_come_back_as_a_float64_batch(given_poses):
    checked = check_poses(given_poses)
    assert checked.shape == (1, 4, 4)
    assert checked.dtype == np.float64
    np.testing.assert_array_equal(checked[0], np.eye(4))


def test_no_poses_are_fine():
    assert check_poses(np.zeros((0, 4, 4))).shape == (0, 4, 4)


def test_a_nearly_exact_rotation_is_made_exact():
    noisy = turned_about_z(30.0)
    noisy[:3, :3] *= 1 + 4e-4
    before = noisy.copy()
    np.testing.assert_allclose(check_poses(noisy)[0], turned_about_z(30.0), atol=1e-12)
    np.testing.assert_array_equal(noisy, before)


@pytest.mark.parametrize("roughness", [0.0, 1e-13, 1e-6])
def test_a_pose_alone_becomes_what_it_becomes_in_a_batch(roughness):
    for degrees in range(0, 360, 7):
        pose = turned_about_z(float(degrees)) @ np.linalg.inv(turned_about_z(11.0))
        pose[:3, :3] += roughness * np.arange(9).reshape(3, 3)
        np.testing.assert_array_equal(check_poses(pose)[0], check_poses(np.stack([pose, np.eye(4)]))[0])


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (np.diag([1.0, 1.0, -1.0, 1.0]), "determinant"),
        (np.diag([1.01, 1.01, 1.01, 1.0]), "axis lengths"),
        (np.diag([1.0, 1.002, 1.0, 1.0]), "rotation"),
        (np.zeros((4, 4)), "0 0 0 1"),
        (changed((3, 3), 2.0), "0 0 0 1"),
        (changed((0, 3), math.nan), "finite"),
        (changed((2, 3), 2e6), "within 1e"),
        (np.eye(3), r"shape \[C, 4, 4\]"),
        (np.eye(4, dtype=bool), "real numbers"),
        ([[1.0], [2.0, 3.0]], "ragged"),
        (None, "real numbers"),
    ],
)
def test_anything_else_is_refused(pose, message):
    with pytest.raises(InvalidPose, match=message) as caught:
        check_poses(pose, field="poses")
    assert caught.value.field.startswith("poses")


def test_the_bad_pose_of_a_batch_is_named():
    with pytest.raises(InvalidPose, match=r"poses\[2\] must be finite") as caught:
        check_poses(np.stack([np.eye(4), np.eye(4), changed((1, 1), math.nan)]))
    assert caught.value.field == "poses[2]"
    assert isinstance(caught.value, InvalidArgument)


def test_a_quaternion_is_w_x_y_z():
    """A quarter turn about z takes the lateral axis to the scene's y: w = z = √½."""
    half = math.sqrt(0.5)
    pose = pose_from_position_quaternion((1.0, 2.0, 3.0), (half, 0.0, 0.0, half))
    np.testing.assert_allclose(pose, turned_about_z(90.0), atol=1e-15)
    pose = pose_from_position_quaternion((0.0, 0.0, 0.0), (half, half, 0.0, 0.0))
    np.testing.assert_allclose(pose[:3, :3] @ [0, 1, 0], [0, 0, 1], atol=1e-15)  # about x: y to z
    pose = pose_from_position_quaternion((0.0, 0.0, 0.0), (half, 0.0, half, 0.0))
    np.testing.assert_allclose(pose[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-15)  # about y: z to x


@pytest.mark.parametrize("norm", [0.0, 0.998, 1.002, math.nan, math.inf])
def test_a_quaternion_of_another_norm_is_refused(norm):
    with pytest.raises(InvalidPose, match="norm 1") as caught:
        pose_from_position_quaternion((0, 0, 0), (norm, 0, 0, 0), field="pose")
    assert caught.value.field == "pose.quaternion"


def test_a_quaternion_within_tolerance_is_made_exact():
    np.testing.assert_array_equal(pose_from_position_quaternion((0, 0, 0), (1.0005, 0, 0, 0)), np.eye(4))
    with pytest.raises(InvalidPose, match="finite"):
        pose_from_position_quaternion((math.nan, 0, 0), (1, 0, 0, 0))


components = st.floats(-1, 1)


@given(st.tuples(components, components, components, components).filter(lambda q: np.linalg.norm(q) > 1e-2))
def test_quaternions_survive_the_round_trip(raw):
    w, x, y, z = np.array(raw) / np.linalg.norm(raw)
    pose = pose_from_position_quaternion((4.0, 5.0, 6.0), (w, x, y, z))
    back = quaternion_from_pose(pose)
    assert back[0] >= 0
    assert abs(np.dot(back, (w, x, y, z))) == pytest.approx(1.0, abs=1e-12)  # q and −q are one rotation
    np.testing.assert_allclose(pose_from_position_quaternion((4.0, 5.0, 6.0), back), pose, atol=1e-12)


def test_angles():
    first = np.stack([np.eye(4), turned_about_z(90.0)])
    second = np.stack([np.eye(4), turned_about_z(10.0), np.diag([1.0, -1.0, -1.0, 1.0])])
    np.testing.assert_allclose(rotation_angles_deg(first, second), [[0, 10, 180], [90, 80, 180]], atol=1e-6)
