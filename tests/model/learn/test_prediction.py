"""Held-out frames from the training frames before and after them."""

from dataclasses import replace

import numpy as np
import pytest

from ultragray.errors import DatasetInvalid
from ultragray.learn.evaluation.baselines import BASELINES, IN_TIME, evaluate_baselines, predict_held_out
from ultragray.learn.prediction import NeighboursInTime
from ultragray.learn.sweep import Dataset

from .conftest import make_tiny_dataset

TIMES_S = np.array([0.0, 1.0, 3.0, 4.0, 4.5, 8.0, 9.0])
HELD_OUT = [2, 4, 6]


def recording(times_s=None):
    sweep = replace(make_tiny_dataset().train.select(range(len(TIMES_S))), frame_numbers=np.arange(len(TIMES_S)))
    sweep = replace(sweep, times_s=times_s)
    return Dataset("made", sweep.select(np.setdiff1d(np.arange(len(sweep)), HELD_OUT)), sweep.select(HELD_OUT))


def test_neighbours_are_weighted_by_their_times():
    given = recording(TIMES_S)
    found = NeighboursInTime.of(given)
    assert given.train.frame_numbers[found.frames].tolist() == [[1, 3], [3, 5], [5, 5]]
    assert found.shares == pytest.approx([2.0 / 3.0, 0.5 / 4.0, 0.0])
    images = given.train.images / 255.0
    expected = [images[1] / 3.0 + images[2] * 2.0 / 3.0, images[2] * 7.0 / 8.0 + images[3] / 8.0, images[3]]
    np.testing.assert_allclose(predict_held_out(given, IN_TIME), expected, atol=1e-6)


def test_without_times_numbers_count():
    assert NeighboursInTime.of(recording()).shares == pytest.approx([0.5, 0.5, 0.0])


def test_poses_do_not_matter():
    given = recording(TIMES_S)
    moved = replace(given, val=replace(given.val, poses=given.val.poses[::-1]))
    np.testing.assert_array_equal(predict_held_out(moved, IN_TIME), predict_held_out(given, IN_TIME))


def test_frames_of_another_recording_have_no_neighbours():
    given = recording()
    aside = given.val.poses + 10.0 * np.eye(4)[:, 3] * np.eye(4)[0][:, None]
    apart = replace(given, val=replace(given.val, source="another file", poses=aside))
    with pytest.raises(DatasetInvalid, match=r"another recording \(another file\) than the training frames \(tiny\)"):
        NeighboursInTime.of(apart)
    assert set(evaluate_baselines(apart, ("nearest", IN_TIME))) == {"nearest"}
    assert set(evaluate_baselines(given)) == set(BASELINES)


def test_frames_of_another_file_that_lie_between_the_others_have_them_as_neighbours():
    given = recording()
    between = given.val.poses.copy()
    between[:, 1, 3] += 0.1  # shaken
    other = replace(given, val=replace(given.val, source="another file", frame_numbers=np.arange(3), poses=between))
    assert NeighboursInTime.of(other).frames.tolist() == NeighboursInTime.of(given).frames.tolist()
    alone = replace(other, val=other.val.select([1]))
    assert NeighboursInTime.of(alone).frames.tolist() == NeighboursInTime.of(given).frames[1:2].tolist()


def test_a_time_that_comes_twice_is_told():
    with pytest.raises(DatasetInvalid, match="frames 2 have the times of training"):
        NeighboursInTime.of(recording(np.array([0.0, 1.0, 1.0, 2.0, 3.0, 4.0, 5.0])))
