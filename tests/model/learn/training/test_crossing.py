"""Passes of a tracker that wanders are brought to agree where they cross; exact ones stay as they are."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ultragray.datasets.checks import check_dataset
from ultragray.geometry.rotations import mean_axes
from ultragray.learn.sweep import Dataset, corner_distances_mm
from ultragray.learn.training.agreement import agreed_path
from ultragray.learn.training.alignment import sweep_ranges
from ultragray.learn.training.crossing import _Crossing, crossing_agreement

from .test_poses import PROBE, poses_of, seen

COUNT = 41  # frames of each pass
HELD_OUT = np.array([place for place in range(2 * COUNT) if place % COUNT % 2 == 1])


@cache
def two_passes(away_mm=0.0):
    """Straight ones of 0.5 mm a frame, turned by 80° against each other, the second moved aside."""
    along = poses_of(np.zeros((COUNT, 3)), (np.arange(COUNT)[:, None] - COUNT // 2) * [[0.0, 0.5, 0.0]])
    return seen(np.concatenate([along, poses_of([[0.0, 0.0, 80.0]], [[away_mm, 0.0, 0.0]]) @ along]))


def wandering(poses, mm=0.4, deg=0.3):
    """An error that changes over some dozen frames, another one in each pass."""
    t = np.arange(len(poses))
    waves = np.stack([np.sin(t / 9.0 + phase) for phase in range(6)], axis=1)
    return poses @ poses_of(deg * waves[:, :3], mm * waves[:, 3:])


def recording(images, poses):
    whole = replace(images, poses=poses)
    return Dataset("hand", whole.select(np.setdiff1d(np.arange(len(poses)), HELD_OUT)), whole.select(HELD_OUT))


def error_mm(poses, truth):
    """Of the corners of the images, past the motion of all frames together, which no image tells."""
    turn = mean_axes(truth @ np.linalg.inv(poses))
    corners, wanted = (PROBE.corners_from(one) for one in (poses, truth))
    turned = corners @ turn.T
    return corner_distances_mm(turned + (wanted - turned).mean(axis=(0, 1)), wanted).mean()


def test_what_a_tracker_wanders_comes_off_also_where_frames_are_held_out(found_paths):
    images = two_passes()
    truth, given = images.poses, recording(images, wandering(images.poses))
    report, (path,) = check_dataset(given), found_paths
    assert path.crossing.before < 0.85
    assert path.crossing.after > 0.88
    assert "wander" in report.path.causes
    before, after = given.train.poses, path.train
    trained = np.setdiff1d(np.arange(2 * COUNT), HELD_OUT)
    assert error_mm(after, truth[trained]) < 0.3 * error_mm(before, truth[trained])
    assert error_mm(path.val, truth[HELD_OUT]) < 0.3 * error_mm(given.val.poses, truth[HELD_OUT])
    np.testing.assert_array_equal(path.tracked, before)  # frames are asked for by the poses of the tracker


def test_no_image_of_a_held_out_frame_is_used():
    images = two_passes()
    given = recording(images, wandering(images.poses))
    noise = np.random.default_rng(0).integers(0, 255, given.val.images.shape, dtype=np.uint8)
    other = replace(given, val=replace(given.val, images=noise))
    np.testing.assert_array_equal(agreed_path(other).val, agreed_path(given).val)


def test_exact_poses_stay():
    given = recording(two_passes(), two_passes().poses)
    path = agreed_path(given)
    assert path.crossing is None
    assert path.train is given.train.poses


@pytest.mark.parametrize("away_mm", [0.0, 200.0], ids=["one pass", "passes that do not meet"])
def test_nothing_is_moved_where_nothing_crosses(away_mm):
    images = two_passes(away_mm)
    poses = wandering(images.poses)
    ranges = sweep_ranges(images) if away_mm else [range(len(images))]
    assert crossing_agreement(images, poses, ranges, np.arange(len(images))) is None


def test_one_pass_is_trained_where_the_other_is_held_out():
    images = two_passes()
    given = Dataset("hand", images.select(np.arange(COUNT)), images.select(np.arange(COUNT, 2 * COUNT)))
    path = agreed_path(given)
    assert path.crossing is None
    assert path.train is given.train.poses


def test_how_points_move_with_a_twist_is_the_slope_of_the_motion():
    sweep = two_passes().select(np.arange(0, 2 * COUNT, 20))
    crossing = _Crossing(sweep, np.zeros(len(sweep), np.int64), seed=0)
    points = np.random.default_rng(0).normal(0.0, 10.0, (len(sweep), 3))
    local = np.linalg.inv(sweep.poses) @ np.append(points, np.ones((len(sweep), 1)), axis=1)[..., None]
    slopes = crossing._moved(sweep.poses, points)
    for number in range(6):
        twist = 1e-5 * np.eye(6)[[number] * len(sweep)]
        moved = [sweep.poses @ crossing.motions(sign * twist) @ local for sign in (1.0, -1.0)]
        np.testing.assert_allclose(slopes[..., number], ((moved[0] - moved[1]) / 2e-5)[:, :3, 0], atol=1e-6)
