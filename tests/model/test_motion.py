"""The prediction of a probe's pose, on paths whose future is known."""

import numpy as np
import pytest

from ultragray.geometry.motion import MAX_AHEAD_MS, PathPredictor
from ultragray.geometry.rotations import blended, rotations_of, turns_of

AHEAD_S = 0.05


def hand_at(times_s):  # [N] -> [N, 4, 4] mm
    """A hand that sweeps to and fro at up to 20 mm/s, and sways and turns meanwhile."""
    t = np.asarray(times_s)
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    turns_deg = np.stack([6 * np.sin(1.3 * t), 4 * np.sin(2.1 * t + 1), 5 * np.sin(0.7 * t)], axis=1)
    poses[:, :3, :3] = rotations_of(np.radians(turns_deg))
    poses[:, :3, 3] = np.stack([2 * np.sin(2.5 * t), 30 * np.sin(0.6 * t), np.sin(1.9 * t)], axis=1)
    return poses


def shaken(poses, noise, seed=0):  # mm and degrees
    random = np.random.default_rng(seed)
    there = poses.copy()
    there[:, :3, 3] += random.normal(scale=noise, size=(len(poses), 3))
    there[:, :3, :3] @= rotations_of(np.radians(random.normal(scale=noise, size=(len(poses), 3))))
    return there


def rest(count):
    return np.tile(np.eye(4), (count, 1, 1))


def between(times_s, poses, at_s):  # [N], [N, 4, 4], [C] -> [C, 4, 4]
    place = np.clip(np.searchsorted(times_s, at_s), 1, len(times_s) - 1)
    share = (at_s - times_s[place - 1]) / (times_s[place] - times_s[place - 1])
    found = poses[place].copy()
    found[:, :3, 3] = (1 - share)[:, None] * poses[place - 1, :3, 3] + share[:, None] * poses[place, :3, 3]
    found[:, :3, :3] = blended(poses[place - 1, :3, :3], poses[place, :3, :3], share)
    return found


def foretold(times_s, poses, ahead_s=AHEAD_S):
    """The poses [N, 4, 4] that are foretold from each of a path, and what is told of them."""
    path = PathPredictor()
    found = []
    for time_s, pose in zip(times_s, poses, strict=True):
        path.observe(time_s, pose)
        found.append(path.predict(time_s + ahead_s))
    return np.stack([pose for pose, _ in found]), [told for _, told in found]


def rms(poses, truth):  # mm, degrees
    shifts = np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    turns = np.linalg.norm(turns_of(poses[:, :3, :3].transpose(0, 2, 1) @ truth[:, :3, :3]), axis=1)
    return np.sqrt((shifts**2).mean()), np.degrees(np.sqrt((turns**2).mean()))


@pytest.mark.parametrize("rate_hz", [30, 60, 200])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_at_50_ms_a_third_of_the_error_is_left_and_it_is_as_large_as_is_told(rate_hz, noise):
    times = np.arange(0, 20, 1 / rate_hz)
    poses = shaken(hand_at(times), noise)
    found, told = foretold(times, poses)
    truth = hand_at(times + AHEAD_S)
    settled = len(times) // 10
    left, without = rms(found[settled:], truth[settled:]), rms(poses[settled:], truth[settled:])
    assert left[0] <= without[0] / 3
    assert left[1] <= without[1] / 2.5  # degrees; the noise has as many of them as mm, and the path a quarter
    expected = np.array([(one.error_mm, one.error_deg) for one in told[settled:]])
    seen_noise = noise * np.sqrt(3)  # what came true was measured with it
    assert np.sqrt((expected**2).mean(axis=0)) == pytest.approx(np.hypot(left, seen_noise), rel=0.35, abs=0.03)
    assert {one.ahead_ms for one in told} == {1e3 * AHEAD_S}


@pytest.mark.parametrize("ahead_s", [0.02, 0.1, 0.3, 1.0])
@pytest.mark.parametrize("noise", [0.0, 0.13, 0.3])
@pytest.mark.parametrize("path", [hand_at, lambda times: rest(len(times))], ids=["hand", "rest"])
def test_it_is_never_much_worse_than_the_newest_pose(path, noise, ahead_s):
    times = np.arange(0, 12, 0.05)
    poses = shaken(path(times), noise)
    found, _ = foretold(times, poses, ahead_s)
    truth = path(times + ahead_s)
    for left, without in zip(rms(found, truth), rms(poses, truth), strict=True):
        assert left <= 1.1 * without + 1e-9


@pytest.mark.parametrize("ahead_s", [0.05, 0.1, 0.3])
def test_a_recorded_hand_is_foretold_better_than_by_its_newest_pose(data_folder, ahead_s):
    from ultragray.datasets.source import SourceOptions, load_dataset

    folder = data_folder / "plus_freehand"
    options = SourceOptions(device_set=folder / "BoneUltrasound_L14_config.xml")
    sweep = load_dataset(str(folder / "BoneUltrasound_L14.igs.mha"), options).train
    found, _ = foretold(sweep.times_s, sweep.poses, ahead_s)
    known = sweep.times_s + ahead_s <= sweep.times_s[-1]
    truth = between(sweep.times_s, sweep.poses, sweep.times_s[known] + ahead_s)
    for left, without in zip(rms(found[known], truth), rms(sweep.poses[known], truth), strict=True):
        assert left < without


def test_nothing_is_foretold_of_a_first_pose_of_no_time_and_of_poses_that_come_again():
    pose = hand_at([3.0])[0]
    path = PathPredictor()
    path.observe(5.0, pose)
    found, told = path.predict(5.05)
    np.testing.assert_array_equal(found, pose)
    assert (told.error_mm, told.error_deg) == (None, None)
    path.observe(5.0, pose)
    path.observe(4.9, np.eye(4))  # a late one
    np.testing.assert_array_equal(path.predict(5.0)[0], pose)


@pytest.mark.parametrize("back_s", [0.5, 3600.0, -1e6])
def test_where_a_clock_is_set_the_path_begins_anew(back_s):
    """Set forth by one stamp only, which the rest then lie far before."""
    times = np.arange(0, 3, 0.02)
    poses, path = hand_at(times), PathPredictor()
    stamps = times - np.where(times >= 2.0, back_s, 0.0) if back_s > 0.0 else times + 1e6 * (times == times[100])
    for number, (stamp_s, pose) in enumerate(zip(stamps, poses, strict=True)):
        path.observe(stamp_s, pose)
        found, told = path.predict(stamp_s + AHEAD_S)
        if number == (102 if back_s == 0.5 else 100):  # nothing is known of the motion: the error is that of none
            np.testing.assert_array_equal(found, pose)
            assert told.error_mm > 0.5
    assert rms(found[None], hand_at([times[-1] + AHEAD_S]))[0] < 0.2


def test_after_a_jump_at_one_time_the_path_begins_anew():
    times = np.arange(0, 1, 0.04)
    poses, path = hand_at(times), PathPredictor()
    for time_s, pose in zip(times, poses, strict=True):
        path.observe(time_s, pose)
    after = poses[-1].copy()
    after[0, 3] += 100.0
    path.observe(times[-1], after)
    np.testing.assert_array_equal(path.predict(times[-1] + AHEAD_S)[0], after)


def test_poses_of_one_time_are_followed():
    path = PathPredictor()
    for pose in hand_at(np.arange(0, 1, 0.02)):
        path.observe(5.0, pose)
        np.testing.assert_array_equal(path.predict(5.05)[0], pose)


@pytest.mark.parametrize("jump", ["of the tracker", "of time"])
def test_after_a_jump_the_path_begins_anew(jump):
    times = np.arange(0, 5, 0.02)
    poses = hand_at(times)
    path = PathPredictor()
    for time_s, pose in zip(times, poses, strict=True):
        path.observe(time_s, pose)
        path.predict(time_s + AHEAD_S)
    after = hand_at([5.0 if jump == "of the tracker" else 7.0])[0]
    after[0, 3] += 100.0 if jump == "of the tracker" else 0.0
    path.observe(5.0 if jump == "of the tracker" else 7.0, after)
    np.testing.assert_array_equal(path.predict(7.05)[0], after)


def test_no_more_than_thirty_millimetres_and_degrees_are_foretold():
    times = np.arange(0, 3, 0.02)
    poses = rest(len(times))
    poses[:, 0, 3] = 200.0 * times
    poses[:, :3, :3] = rotations_of(np.outer(times, [0.0, 0.0, 1.2]))
    found, _ = foretold(times, poses, ahead_s=1.0)
    lengths = np.linalg.norm(found[:, :3, 3] - poses[:, :3, 3], axis=1)
    angles = np.linalg.norm(turns_of(poses[:, :3, :3].transpose(0, 2, 1) @ found[:, :3, :3]), axis=1)
    assert lengths.max() == pytest.approx(30.0)
    assert np.degrees(angles.max()) == pytest.approx(30.0)


def test_no_more_than_a_second_is_foretold():
    times = np.arange(0, 3, 0.02)
    found, told = foretold(times, hand_at(times), ahead_s=60.0)
    assert {one.ahead_ms for one in told} == {MAX_AHEAD_MS}
    assert np.abs(found[:, :3, 3]).max() < 200.0
