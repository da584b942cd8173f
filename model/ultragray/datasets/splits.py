"""The split of a sweep into frames to train from and frames held out.

Ranges of frames are what a user writes: `0:90`, `0:90,100:120:2`, `7`, `:50`, `150:`.
"""

from __future__ import annotations

import re

from ultragray.datasets.sweep import Sweep
from ultragray.errors import InvalidArgument

HELD_OUT_START, HELD_OUT_STEP = 2, 5  # of a single sequence: every fifth frame, from the third
_PART = re.compile(r"(?P<start>\d{0,9})(?P<range>:(?P<stop>\d{0,9})(:(?P<step>\d{1,9}))?)?")


def split_parts(train: Sweep, val: Sweep, train_frames: str | None, val_frames: str | None) -> tuple[Sweep, Sweep]:
    """Training and held-out frames of a dataset that has both parts; ranges are places in its training part.

    `train_frames` alone keeps the held-out part. `val_frames` alone trains from all other frames of the training
    part, and the held-out part is not used. Raises InvalidArgument for ranges that overlap or do not exist.
    """
    chosen_train, chosen_val = _chosen(len(train), train_frames, val_frames)
    if chosen_val is None:
        return (train if chosen_train is None else train.select(chosen_train)), val
    if chosen_train is None:
        chosen_train = _others(len(train), chosen_val)
    return train.select(chosen_train), train.select(chosen_val)


def split_sequence(
    sweep: Sweep, frame_count: int, train_frames: str | None, val_frames: str | None
) -> tuple[Sweep, Sweep]:
    """Training and held-out frames of a single sequence; ranges are frame numbers 0 … frame_count − 1 of its file.

    Frames that the sweep lacks, such as those without a pose, are passed over. With one range the other part is all
    other frames; with none every fifth frame of the sweep, from the third, is held out.
    """
    chosen_train, chosen_val = _chosen(frame_count, train_frames, val_frames)
    if chosen_train is None and chosen_val is None:
        held_out = list(range(HELD_OUT_START, len(sweep), HELD_OUT_STEP))
        return sweep.select(_others(len(sweep), held_out)), sweep.select(held_out)
    if chosen_train is None:
        chosen_train = _others(frame_count, chosen_val or [])
    if chosen_val is None:
        chosen_val = _others(frame_count, chosen_train)
    place = {int(number): i for i, number in enumerate(sweep.frame_numbers)}
    train, val = ([place[number] for number in part if number in place] for part in (chosen_train, chosen_val))
    return sweep.select(train), sweep.select(val)


def _chosen(count: int, train_frames: str | None, val_frames: str | None) -> tuple[list[int] | None, list[int] | None]:
    train, val = (
        None if text is None else parse_frame_ranges(text, count, option=option)
        for text, option in ((train_frames, "train_frames"), (val_frames, "val_frames"))
    )
    shared = sorted(set(train or ()) & set(val or ()))
    if shared:
        raise InvalidArgument(
            f"train_frames and val_frames share {len(shared)} frames, the first is {shared[0]}: a frame that was "
            "trained from cannot be held out",
            field="val_frames",
        )
    return train, val


def _others(count: int, chosen: list[int]) -> list[int]:
    taken = set(chosen)
    return [i for i in range(count) if i not in taken]


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
