"""The path that neighbouring frames agree with: shaking and dragging come out, exact poses of rigid tissue stay."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ultragray.datasets.checks import check_dataset
from ultragray.geometry.rotations import turns_of
from ultragray.learn.evaluation.scoring import evaluate
from ultragray.learn.sweep import Dataset, Sweep, corner_distances_mm
from ultragray.learn.training import agreement, train
from ultragray.learn.training.agreement import RIGID, agreed_path, with_shares
from ultragray.learn.training.poses import held_out_on_path

from .test_poses import PROBE, poses_of, seen, shaken

FRAMES = 60


def hand_path(count=FRAMES):  # [F, 4, 4]
    """Along y by 0.5 mm a frame, swaying by some millimetres and degrees in all directions."""
    t = np.arange(count)
    turns = np.stack([np.sin(t / 9.0), 1.5 * np.sin(t / 7.0), np.cos(t / 11.0)], axis=1)
    places = np.stack([1.5 * np.sin(t / 8.0), 0.5 * t, np.sin(t / 6.0)], axis=1)
    return poses_of(turns, places)


def recording(shown, tracked):
    """A sweep of tissue seen from one path and tracked on another; every second frame is held out."""
    whole = replace(seen(shown), poses=tracked)
    return Dataset("hand", train=whole.select(np.arange(0, FRAMES, 2)), val=whole.select(np.arange(1, FRAMES, 2)))


@cache
def known(kind):
    """A recording that several tests look at, and its path."""
    truth = hand_path()
    shown, tracked = {
        "exact": lambda: (truth, truth),
        "shaking": lambda: (truth, shaken(truth, 0.3, 0.2)),
        "shaking little": lambda: (truth, shaken(truth, 0.1, 0.1)),
        "following": lambda: (with_shares(truth, [range(FRAMES)], PROBE, (0.0, 0.0, 0.0)), truth),
    }[kind]()
    given = recording(shown, tracked)
    return given, agreed_path(given)


def error_mm(poses, truth):
    """The mean error of the steps from frame to frame, which no common motion of all changes."""
    steps = [np.linalg.inv(some[:-1]) @ some[1:] for some in (poses, truth)]
    return corner_distances_mm(*(PROBE.corners_from(one) for one in steps)).mean()


@pytest.mark.parametrize("kind", ["shaking little", "shaking"])
def test_a_shaking_tracker_is_smoothed_also_where_frames_are_held_out(kind):
    truth, (given, path) = hand_path(), known(kind)
    assert path.shares == RIGID
    assert path.found_db > path.tracked_db + 0.2
    for poses, tracked, true in ((path.train, given.train, truth[::2]), (path.val, given.val, truth[1::2])):
        assert error_mm(poses, true) < 0.6 * error_mm(tracked.poses, true)


def test_no_image_of_a_held_out_frame_is_used():
    given, path = known("shaking")
    changed = replace(given, val=replace(given.val, images=given.val.images[::-1]))
    np.testing.assert_array_equal(agreed_path(changed).val, path.val)


@pytest.mark.parametrize("share", [0.0, 0.25])
def test_tissue_that_follows_the_probe_is_found(share):
    tracked = hand_path()
    shown = with_shares(tracked, [range(FRAMES)], PROBE, (share,) * 3)
    given = recording(shown, tracked)
    path = agreed_path(given) if share else known("following")[1]
    assert path.shares == pytest.approx((share,) * 3, abs=0.3)
    assert path.in_time_db > path.tracked_db
    assert error_mm(path.train, shown[::2]) < 0.35 * error_mm(given.train.poses, shown[::2])


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_a_slow_hand_is_told_from_tissue_that_follows(share):
    """Frames move by a fraction of a pixel from one to the next: neighbours fit whatever the tissue does."""
    t = np.arange(80) / 3.0
    turns = np.stack([2.0 * np.sin(t / 9.0), 3.0 * np.sin(t / 7.0), 2.0 * np.cos(t / 11.0)], axis=1)
    places = np.stack([3.0 * np.sin(t / 8.0), 0.6 * t, 2.0 * np.sin(t / 6.0)], axis=1)
    tracked = poses_of(turns, places)
    shown = with_shares(tracked, [range(len(t))], PROBE, (share,) * 3)
    whole = replace(seen(shown), poses=tracked)
    given = Dataset("hand", train=whole.select(np.arange(0, 80, 2)), val=whole.select(np.arange(1, 80, 2)))
    assert agreed_path(given).shares == (share,) * 3


def test_a_path_with_inexact_times_is_evened_out_across_the_plane():
    """Noise along the way alone may be a hand that goes unevenly: only images tell."""
    truth = hand_path()
    tracked = truth.copy()
    tracked[:, :3, 3] += np.random.default_rng(5).normal(0.0, 0.15, (FRAMES, 1)) * truth[:, :3, 1]
    given = recording(truth, tracked)
    path = agreed_path(given)
    assert path.shares == RIGID
    for found, told, at in ((path.train, given.train.poses, truth[::2]), (path.val, given.val.poses, truth[1::2])):
        assert error_mm(found, at) < 0.3 * error_mm(told, at)
    np.testing.assert_array_equal(path.tracked, given.train.poses)
    assert path.found_db > path.tracked_db + agreement.GAIN_OF_EVENNESS_DB


@pytest.mark.parametrize("slow", [1.0, 3.0])
def test_a_hand_that_goes_unevenly_keeps_its_path(slow):
    truth = hand_path()
    uneven = 0.3 * np.sin(np.arange(FRAMES) * 2.0 / slow) + 0.1 * np.cos(np.arange(FRAMES) ** 2)
    truth[:, :3, 3] += uneven[:, None] * truth[:, :3, 1]
    given = recording(truth, truth)
    np.testing.assert_array_equal(agreed_path(given).train, given.train.poses)


def two_passes(share):
    """Tissue of which a share of the motion within the plane is seen, in two passes that cross; and the true path."""
    other = poses_of(np.tile([8.0, 0.0, 0.0], (FRAMES, 1)), np.tile([1.0, 0.0, 0.0], (FRAMES, 1)))
    tracked = np.concatenate([hand_path(), hand_path() @ other])
    rest = with_shares(tracked, [range(FRAMES), range(FRAMES, 2 * FRAMES)], PROBE, (share,) * 3)
    whole = replace(seen(rest), poses=tracked)
    return Dataset("hand", train=whole, val=whole.select([])), rest


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_passes_that_cross_agree_on_the_true_path(share):
    given, rest = two_passes(share)
    judge = agreement._Judge.of(given.train, agreement.sweep_ranges(given.train))
    other = with_shares(given.train.poses, agreement.sweep_ranges(given.train), PROBE, (1.25 - share,) * 3)
    assert judge.crossing_db(rest) > judge.crossing_db(other) + 1.0
    assert agreed_path(given).shares == pytest.approx((share,) * 3, abs=0.3)


def test_no_share_is_taken_that_passes_which_cross_contradict(monkeypatch):
    given, path = known("following")
    assert path.shares != RIGID
    crossing_db = iter([21.0, 20.0])
    monkeypatch.setattr(agreement._Judge, "crossing_db", lambda judge, poses: next(crossing_db))
    assert agreed_path(given).shares == RIGID


def test_text_that_is_burnt_in_tells_nothing_of_tissue(monkeypatch):
    given, path = known("exact")
    rows, columns = np.mgrid[: given.train.height, : given.train.width]
    text = (rows % 6 < 3) & (columns % 6 < 3) & (rows < 30)
    parts = [
        replace(part, images=np.where(text, 230, part.images).astype(np.uint8)) for part in (given.train, given.val)
    ]
    written = replace(given, train=parts[0], val=parts[1])
    assert path.shares == agreed_path(written).shares == RIGID
    monkeypatch.setattr(agreement, "_marks_of", lambda sweep: None)
    assert agreed_path(written).shares != RIGID  # it would


def test_no_share_is_taken_by_which_only_far_frames_are_predicted_better(monkeypatch):
    given, path = known("following")
    assert path.shares != RIGID
    frames_db = agreement._Judge.frames_db

    def only_far(judge, poses, reach=1):
        return np.full(len(judge.frames), 20.0) if reach == 1 else frames_db(judge, poses, 1)

    monkeypatch.setattr(agreement._Judge, "frames_db", only_far)
    assert agreed_path(given).shares == RIGID


def test_a_few_frames_do_not_tell_of_tissue():
    tracked = hand_path()
    given = recording(with_shares(tracked, [range(FRAMES)], PROBE, (0.0, 0.0, 0.0)), tracked)
    few = replace(given, train=given.train.select(np.arange(9)), val=given.val.select(np.arange(8)))
    assert agreed_path(few).shares == RIGID


def test_a_check_tells_of_it(found_paths):
    truth = hand_path()
    given = recording(with_shares(truth, [range(FRAMES)], PROBE, (0.0, 0.0, 0.0)), shaken(truth, 0.3, 0.2))
    report, (path,) = check_dataset(given), found_paths
    (told,) = (text for text in report.warnings if "neighbours in time" in text)
    assert f"{path.in_time_db - path.tracked_db:.1f} dB better than by their poses" in told
    assert report.path.causes == ("shaking", "tissue")
    assert set(report.path.warnings) <= set(report.warnings)
    exact = check_dataset(known("exact")[0])
    assert exact.path.causes == exact.path.warnings == ()


def test_a_scene_is_trained_and_measured_on_the_path(tiny_config):
    given, path = known("following")
    scene = train(given, tiny_config(refine_poses="path"))
    np.testing.assert_array_equal(scene.training_poses, given.train.poses)
    np.testing.assert_array_equal(scene.rest_poses, path.train)
    assert scene.info.tissue_shares == path.shares
    placed = held_out_on_path(given, scene)
    np.testing.assert_array_equal(placed.poses, path.val)
    assert scene.info.metrics == evaluate(scene.at_rest(), placed).mean.to_dict()
    as_asked, as_tracked = (
        corner_distances_mm(*(PROBE.corners_from(some) for some in (poses, placed.poses))).mean()
        for poses in (scene.poses_at_rest(given.val.poses), given.val.poses)
    )
    assert as_asked < 0.1 * as_tracked
    assert held_out_on_path(replace(given, train=given.train.select(range(20))), scene) is None
    assert held_out_on_path(given, replace(scene, rest_poses=scene.training_poses)) is None  # of another path
    assert held_out_on_path(given, train(given, tiny_config(refine_poses="none"))) is None


def test_a_path_without_noise_alone_is_that_of_the_scene(tiny_config):
    given, path = known("shaking")
    scene = train(given, tiny_config(steps=1))
    assert scene.tissue is None
    np.testing.assert_allclose(scene.training_poses, path.train, atol=1e-12)
    np.testing.assert_allclose(scene.pose_corrections @ given.train.poses, path.train, atol=1e-9)


def test_exact_poses_of_rigid_tissue_stay():
    given, path = known("exact")
    assert path.of(given) is given
    assert path.shares == RIGID


def test_a_probe_that_is_lifted_off_does_not_tell_that_tissue_follows():
    """Air looks the same wherever the probe goes, as if it followed it."""
    away = hand_path()[-1] @ poses_of(np.zeros((30, 3)), np.arange(1, 31)[:, None] * [[2.0, 0.5, -5.0]])
    tissue = seen(hand_path())
    noise = np.random.default_rng(0).integers(0, 3, (30, *tissue.images.shape[1:]), dtype=np.uint8)
    air = (200.0 * np.exp(-np.arange(tissue.height) / 3.0)).astype(np.uint8)[:, None] + noise
    whole = Sweep(
        np.concatenate([tissue.images, air]), np.concatenate([tissue.poses, away]), PROBE, np.arange(90), "lifted off"
    )
    given = Dataset("hand", whole.select(np.arange(0, 90, 2)), whole.select(np.arange(1, 90, 2)))
    path = agreed_path(given)
    assert path.shares == RIGID
    assert path.train is given.train.poses


def test_a_calibration_by_which_neighbours_predict_each_other_worse_is_not_taken(monkeypatch):
    turned, (given, _) = np.eye(4), known("exact")
    turned[:3, :3] = poses_of(np.array([[0.0, 90.0, 0.0]]), np.zeros((1, 3)))[0, :3, :3]
    for calibration, is_taken in ((turned, False), (poses_of(np.zeros((1, 3)), np.full((1, 3), 0.1))[0], True)):
        monkeypatch.setattr(agreement, "found_calibration", lambda sweep, ranges, one=calibration: one)
        path = agreed_path(given)
        np.testing.assert_array_equal(path.calibration, calibration if is_taken else np.eye(4))
        np.testing.assert_allclose(path.train, given.train.poses @ path.calibration, atol=1e-9)


def test_held_out_frames_of_another_file_move_with_the_frames_about_them():
    given, path = known("following")
    aside = given.val.poses.copy()
    aside[:, :3, 3] += 2.0 * aside[:, :3, 0]
    apart = agreed_path(replace(given, val=replace(given.val, source="another file", poses=aside)))
    together = path.val.copy()
    together[:, :3, 3] += 2.0 * together[:, :3, 0]
    assert error_mm(apart.val, together) < 0.5 * error_mm(aside, together)
    np.testing.assert_allclose(apart.train, agreed_path(replace(given, val=given.val.select([]))).train)


def test_held_out_frames_of_another_file_that_lie_between_the_others_are_of_the_same_path():
    given, together = known("shaking little")
    without_numbers = replace(given.val, source="another file", frame_numbers=np.arange(len(given.val)))
    without_numbers_of_train = replace(given.train, frame_numbers=np.arange(len(given.train)))
    other = Dataset("hand", without_numbers_of_train, without_numbers)
    apart = agreed_path(other)
    np.testing.assert_array_equal(apart.train, together.train)
    np.testing.assert_array_equal(apart.val, together.val)


def test_a_share_of_the_motion_within_the_plane():
    poses = hand_path(20)
    middle = PROBE.corners_mm().mean(axis=0)

    def motions(path):  # [F − 1, 6] turns and shifts of the middle from frame to frame
        steps = np.linalg.inv(path[:-1]) @ path[1:]
        return np.concatenate(
            [turns_of(steps[:, :3, :3]), steps[:, :3, :3] @ middle + steps[:, :3, 3] - middle], axis=1
        )

    moved = with_shares(poses, [range(8), range(8, 20)], PROBE, (0.5, 0.25, 0.0))
    for sweep in (slice(0, 8), slice(8, 20)):
        expected = motions(poses[sweep]) * (1.0, 0.0, 1.0, 0.5, 1.0, 0.25)
        np.testing.assert_allclose(motions(moved[sweep]), expected, atol=1e-9)
        corners = [PROBE.corners_from(path[sweep]).reshape(-1, 3) for path in (moved, poses)]
        np.testing.assert_allclose(*(points.mean(axis=0) for points in corners), atol=1e-9)
    assert with_shares(poses, [range(20)], PROBE, RIGID) is poses


def test_sweeps_too_short_to_be_predicted_stay():
    poses = poses_of(np.zeros((2, 3)), [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    given = seen(poses)
    assert agreed_path(Dataset("short", given, given.select([]))) is None
