"""What is wrong with the poses of a sweep, in numbers and in words."""

from dataclasses import replace

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.contract import to_dict
from ultragray.datasets.causes import PathReport
from ultragray.learn.training.agreement import RIGID, AgreedPath
from ultragray.learn.training.alignment import TrackerNoise
from ultragray.learn.training.crossing import Agreement

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
POSES = np.tile(np.eye(4), (3, 1, 1))
NOISE = TrackerNoise(0.13, 0.004, (0.2, 0.5, 0.1))
GOOD = AgreedPath(POSES, POSES[:0], POSES, 30.0, 30.0, NOISE, False, 0.0, 30.0, np.eye(4), RIGID, False, None)


def report(**found):
    return PathReport.of(replace(GOOD, **found), PROBE)


def test_good_poses_have_nothing_wrong():
    assert report().causes == report().warnings == ()


@pytest.mark.parametrize(
    ("cause", "found", "words"),
    [
        ("shaking", {"is_smoothed": True}, "the tracker shakes: from frame to frame it errs by 0.13 mm and 0.004°"),
        ("delay", {"delay_s": 0.05}, "images seem to be 50 ms later than their poses: with poses of that time before"),
        ("delay", {"delay_s": -0.021}, "images seem to be 21 ms earlier than their poses: with poses of that time aft"),
        ("tissue", {"shares": (0.25, 0.0, 1.0)}, "images show 25% laterally, 0% axially and 100% of the turn"),
        ("uneven", {"is_evened": True}, "images have inexact times, or the tracker repeats poses"),
        ("wander", {"crossing": Agreement(POSES, 0.5, 0.55, 0.61)}, "0.5 mm root mean square, which raises it to 0.61"),
    ],
)
def test_each_cause_is_told_in_a_sentence_of_its_own(cause, found, words):
    told = report(**found)
    assert told.causes == (cause,)
    (sentence,) = told.warnings
    assert words in sentence


def test_a_calibration_that_is_off_is_told_with_its_size():
    calibration = np.eye(4)
    calibration[1, 3] = 3.0
    told = report(calibration=calibration)
    assert (told.causes, told.calibration_mm, told.calibration_deg) == (("calibration",), 3.0, 0.0)


def test_neighbours_in_time_that_predict_better_are_told_with_what_a_training_makes_of_it():
    for found, words in (({}, "none of the known causes"), ({"is_evened": True}, "a training regains 1.4 dB")):
        first, *_ = report(in_time_db=32.0, found_db=31.4, **found).warnings
        assert first.startswith("the two neighbours in time predict a frame 2.0 dB better than by their poses")
        assert words in first


def test_a_report_is_json():
    document = to_dict(report(shares=(0.5, 0.5, 0.5), delay_s=0.05))
    assert (document["causes"], document["delay_ms"]) == (["delay", "tissue"], 50.0)
    assert document["tissue_shares"] == [0.5, 0.5, 0.5]
    assert document["crossing_before"] is None
