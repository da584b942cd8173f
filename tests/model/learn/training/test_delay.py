"""A delay of the images, and a calibration that is off: found by what images say, where the motion tells them."""

from dataclasses import replace

import numpy as np
import pytest

from ultragray.datasets.checks import check_dataset
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import agreement
from ultragray.learn.training.agreement import agreed_path
from ultragray.learn.training.alignment import found_calibration, sweep_ranges
from ultragray.learn.training.delay import with_delay

from .test_agreement import FRAMES, error_mm
from .test_poses import PROBE, poses_of, seen

SPACING_S = 0.05


def trembling_path(frames):  # [F] -> [F, 4, 4]
    """Along y, trembling every 12 frames."""
    t = np.asarray(frames, np.float64)
    turns = np.stack([np.sin(t / 2.0), np.sin(t / 1.9), np.cos(t / 2.2)], axis=1)
    return poses_of(turns, np.stack([0.5 * np.sin(t / 2.0), 0.5 * t, 0.5 * np.sin(t / 1.8)], axis=1))


def recorded(delay_frames, **more):
    """Images of one time with the poses of a later one; every second frame is held out."""
    shown = replace(seen(trembling_path(np.arange(FRAMES))), **more)
    whole = replace(shown, poses=trembling_path(np.arange(FRAMES) + delay_frames))
    return Dataset("hand", train=whole.select(np.arange(0, FRAMES, 2)), val=whole.select(np.arange(1, FRAMES, 2)))


def test_a_delay_is_found_and_taken_off(found_paths):
    given = recorded(1.0, times_s=SPACING_S * np.arange(FRAMES))
    report, truth = check_dataset(given), trembling_path(np.arange(FRAMES))
    (path,) = found_paths
    assert path.delay_s == pytest.approx(SPACING_S, abs=0.2 * SPACING_S)
    assert "delay" in report.path.causes
    for poses, tracked, true in ((path.train, given.train, truth[::2]), (path.val, given.val, truth[1::2])):
        assert error_mm(poses, true) < 0.3 * error_mm(tracked.poses, true)
    assert agreed_path(recorded(0.0, times_s=SPACING_S * np.arange(FRAMES))).delay_s == 0.0
    assert agreed_path(recorded(1.0)).delay_s == 0.0  # the frames have no times


@pytest.mark.parametrize(("crop", "kept"), [("188:632,12:600", "0:21"), ("180:640,20:300", "1:21:2")])
def test_a_real_hand_of_a_few_frames_tells_no_delay(data_folder, monkeypatch, crop, kept):
    """One explains frames at 129 ms, but its opposite does so nearly as well; shares explain them better than -398."""
    folder = data_folder / "plus_freehand"
    options = SourceOptions(device_set=folder / "BoneUltrasound_L14_config.xml", crop=crop, train_frames=kept)
    given = load_dataset(str(folder / "BoneUltrasound_L14.igs.mha"), options)
    assert agreed_path(given).delay_s == 0.0
    monkeypatch.setattr(agreement, "LEAST_DELAYED", 1)
    assert agreed_path(given).delay_s == 0.0


def test_poses_of_another_time_lie_on_the_path():
    steady = poses_of(np.zeros((8, 3)), np.arange(8)[:, None] * [[1.0, 2.0, 0.0]])
    moved = with_delay(steady, np.arange(8) * 0.1, [range(3), range(3, 8)], 0.25)
    np.testing.assert_allclose(moved[:, :3, 3], steady[:, :3, 3] - [2.5, 5.0, 0.0], atol=1e-9)


@pytest.mark.lengthy
def test_a_calibration_that_is_off_is_found_where_sweeps_cross(found_paths):
    middle = poses_of(np.zeros((30, 3)), np.arange(30)[:, None] * [[0.0, 0.5, 0.0]] - [0.0, 7.5, 0.0])
    truth = np.concatenate([middle, poses_of([[0.0, 0.0, 90.0]], np.zeros((1, 3))) @ middle])
    off = poses_of([[1.0, -1.0, 0.0]], [[0.8, -0.8, 0.0]])[0]
    images = seen(truth)
    given = replace(images, poses=truth @ off)
    ranges = [range(30), range(30, 60)]
    assert sweep_ranges(given) == ranges
    assert "calibration" in check_dataset(Dataset("crossing", given, given.select([]))).path.causes
    found = off @ found_paths[0].calibration
    left, before = (PROBE.corners_from(one[None]) - PROBE.corners_mm() for one in (found, off))
    assert np.linalg.norm(left, axis=-1).mean() < 0.3 * np.linalg.norm(before, axis=-1).mean()
    np.testing.assert_array_equal(found_calibration(images, ranges), np.eye(4))
    np.testing.assert_array_equal(found_calibration(given, [range(60)]), np.eye(4))  # one sweep tells none


def test_a_time_that_comes_twice_leaves_its_pose():
    steady = poses_of(np.zeros((4, 3)), np.arange(4.0)[:, None] * [0.0, 1.0, 0.0])
    moved = with_delay(steady, np.array([0.0, 0.1, 0.2, 0.2]), [range(4)], -0.1)
    assert np.isfinite(moved).all()
    np.testing.assert_allclose(moved[:2, 1, 3], [1.0, 2.0])
