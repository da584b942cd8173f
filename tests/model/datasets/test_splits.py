"""Which frames train and which are held out, and how far image planes lie from each other."""

import math

import numpy as np
import pytest

from ultragray.errors import InvalidArgument
from ultragray.learn.sweep import corner_distances_mm, parse_frame_ranges, split_parts, split_sequence


def numbers(parts):
    return parts[0].frame_numbers.tolist(), parts[1].frame_numbers.tolist()


def test_two_parts_stay_or_follow_the_ranges(make_sweep):
    train, val = make_sweep(6), make_sweep(3, frame_numbers=[100, 101, 102])
    assert numbers(split_parts(train, make_sweep(3), None, None)) == (list(range(6)), [0, 1, 2])
    parts = split_parts(train, val, "0:4", None)
    assert parts[0].frame_numbers.tolist() == [0, 1, 2, 3]
    assert parts[1] is val
    assert numbers(split_parts(train, make_sweep(3), None, "1,4")) == ([0, 2, 3, 5], [1, 4])
    assert numbers(split_parts(train, make_sweep(3), "0:2", "4:")) == ([0, 1], [4, 5])


def test_a_sequence_holds_out_every_fifth_frame(make_sweep):
    train, val = numbers(split_sequence(make_sweep(13), 13, None, None))
    assert val == [2, 7, 12]
    assert train == [0, 1, 3, 4, 5, 6, 8, 9, 10, 11]


def test_ranges_of_a_sequence_are_its_own_frame_numbers(make_sweep):
    sweep = make_sweep(6).select([0, 2, 3, 5])  # 1 and 4 had no pose
    assert numbers(split_sequence(sweep, 6, "0:4", None)) == ([0, 2, 3], [5])
    assert numbers(split_sequence(sweep, 6, None, "3:")) == ([0, 2], [3, 5])
    assert numbers(split_sequence(sweep, 6, "0:3", "5")) == ([0, 2], [5])


def test_frames_of_both_parts_are_refused(make_sweep):
    with pytest.raises(InvalidArgument, match="share 2 frames, the first is 4"):
        split_parts(make_sweep(10), make_sweep(2), "0:6", "4:8")


@pytest.mark.parametrize(
    ("text", "frames"),
    [
        ("7", [7]),
        ("0:3", [0, 1, 2]),
        ("8:", [8, 9]),
        (":", list(range(10))),
        ("2::5", [2, 7]),
        ("0:2,4:9:2, 1", [0, 1, 4, 6, 8]),
        ("0:10", list(range(10))),
    ],
)
def test_ranges_are_those_of_python(text, frames):
    assert parse_frame_ranges(text, 10, option="frames") == frames


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must be frames such as"),
        ("1-3", "must be frames such as"),
        ("0:3:-1", "must be frames such as"),
        ("9" * 5000, "must be frames such as"),
        (f"0:5:{'9' * 5000}", "must be frames such as"),
        ("5:5", "'5:5' names no frame"),
        ("0:5:0", "names no frame"),
        ("10", "goes up to frame 10, but there are only 10"),
        ("0:90", "goes up to frame 89, but there are only 10"),
    ],
)
def test_ranges_that_cannot_be_are_refused(text, message):
    with pytest.raises(InvalidArgument, match=f"^frames.*{message}") as refused:
        parse_frame_ranges(text, 10, option="frames")
    assert len(str(refused.value)) < 200


def test_distances_are_means_over_the_corners(make_sweep):
    corners = make_sweep(5, step_mm=0.3).corners_mm()
    np.testing.assert_allclose(corner_distances_mm(corners[:-1], corners[1:]), [0.3] * 4)
    np.testing.assert_allclose(corner_distances_mm(corners, corners[1]), [0.3, 0.0, 0.3, 0.6, 0.9], atol=1e-12)
    np.testing.assert_allclose(
        corner_distances_mm(corners[:2, None], corners[None]),
        0.3 * np.abs(np.arange(2)[:, None] - np.arange(5)),
        atol=1e-12,
    )


def test_a_turn_about_the_probe_moves_its_far_corners_only(make_sweep):
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 1:3, 1:3] = [[0.0, -1.0], [1.0, 0.0]]  # about the lateral axis
    upright, turned = make_sweep(2, poses=poses).corners_mm()
    np.testing.assert_allclose(corner_distances_mm(upright, turned), 50.0 * math.sqrt(2) / 2)
