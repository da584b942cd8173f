"""Ranges of frames as a user writes them."""

from __future__ import annotations

import pytest

from ultragray.datasets.frame_ranges import parse_frame_ranges
from ultragray.errors import InvalidArgument


@pytest.mark.parametrize(
    ("text", "frames"),
    [
        ("7", [7]),
        ("0:3", [0, 1, 2]),
        (":2", [0, 1]),
        ("8:", [8, 9]),
        (":", list(range(10))),
        ("2::5", [2, 7]),
        ("0:2,4:9:2, 1", [0, 1, 4, 6, 8]),
        ("9", [9]),
        ("0:10", list(range(10))),
    ],
)
def test_ranges_are_those_of_python(text: str, frames: list[int]) -> None:
    assert parse_frame_ranges(text, 10, option="frames") == frames


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must be frames such as"),
        ("a", "must be frames such as"),
        ("1-3", "must be frames such as"),
        ("1,,3", "must be frames such as"),
        ("-1", "must be frames such as"),
        ("0:3:-1", "must be frames such as"),
        ("9" * 5000, "must be frames such as"),
        (f"0:{'9' * 5000}", "must be frames such as"),
        (f"0:5:{'9' * 5000}", "must be frames such as"),
        ("5:5", "'5:5' names no frame"),
        ("0:5:0", "names no frame"),
        ("12:", "names no frame"),
        ("10", "goes up to frame 10, but there are only 10"),
        ("0:90", "goes up to frame 89, but there are only 10"),
    ],
)
def test_ranges_that_cannot_be_are_refused(text: str, message: str) -> None:
    with pytest.raises(InvalidArgument, match=f"^frames.*{message}") as refused:
        parse_frame_ranges(text, 10, option="frames")
    assert len(str(refused.value)) < 200
