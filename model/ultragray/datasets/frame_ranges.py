"""Ranges of frames as a user writes them: `0:90`, `0:90,100:120:2`, `7`, `:50`, `150:`."""

from __future__ import annotations

import re

from ..errors import InvalidArgument

_PART = re.compile(r"(?P<start>\d{0,9})(?P<range>:(?P<stop>\d{0,9})(:(?P<step>\d{1,9}))?)?")


def parse_frame_ranges(text: str, count: int, *, option: str) -> list[int]:
    """The frames that `text` names among `count` of them, ascending, each once.

    Parts are separated by commas: a single frame, or start:stop:step with stop left out, as in Python; start, stop and
    step may be missing. Raises InvalidArgument, naming the option, for anything else, for frames that do not exist and
    for a range without frames.
    """
    chosen: set[int] = set()
    for part in text.split(","):
        match = _PART.fullmatch(part.strip())
        if match is None or not part.strip():
            raise InvalidArgument(
                f"{option} must be frames such as 7, 0:90 or 0:90,100:120:2 (the stop is left out), got {text[:80]!r}",
                field=option,
            )
        frames = _frames(match, count)
        if not len(frames):
            raise InvalidArgument(f"{option}: {part.strip()!r} names no frame", field=option)
        if frames[-1] >= count:
            raise InvalidArgument(
                f"{option}: {part.strip()!r} goes up to frame {frames[-1]}, but there are only {count}, counted from 0",
                field=option,
            )
        chosen.update(frames)
    return sorted(chosen)


def _frames(match: re.Match[str], count: int) -> range:
    if match["range"] is None:
        return range(int(match["start"]), int(match["start"]) + 1)
    start, stop, step = int(match["start"] or 0), int(match["stop"] or count), int(match["step"] or 1)
    return range(start, stop, step) if step else range(0)
