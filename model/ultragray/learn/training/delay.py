"""The delay of a sweep's images behind its poses, by what neighbouring frames say. Read after `agreement`, which calls
it. Free of torch.

With the pose of another time a frame is predicted worse from those beside it, unless the probe moves evenly: a hand
trembles, and tells a delay to some milliseconds. A path that is read between its poses is a smoother one, too, which
may predict better whatever the delay; so a delay has to do better than its opposite. Near its best a prediction falls
with the square of the error, and the opposite loses four times as much as none. Where a delay gains by a smoother path
or by chance it does not: so 11 of 14 delays, -400 to 130 ms, that crops and splits of a real hand's 21 frames told.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import blended

STEPS = (1.0, 0.5, 0.25, 0.125)  # of the usual time from one frame to the next
MOST_S = 0.5
LEAST_GAIN_DB = 0.03  # tissue that goes along feigns a delay that gains 0.01
LEAST_LOSS_OF_OPPOSITE = 2.0  # in gains of the delay: 2.3 to 5 for the phantom's, where nothing else is wrong
LEAST_STEPS = 0.2  # a delay of a smaller share of the usual time is none


def with_delay(
    poses: FloatArray,  # [F, 4, 4] mm
    times_s: FloatArray,  # [F] ascending in each sweep, or the same again
    ranges: Sequence[range],
    delay_s: float,
) -> FloatArray:  # [F, 4, 4] mm
    """The poses a delay before the times of the frames, each sweep by itself; beyond its ends it goes on evenly."""
    delayed_poses = poses.copy()
    for frames in ranges:
        own, own_s = poses[frames.start : frames.stop], times_s[frames.start : frames.stop]
        if len(own) < 2:
            continue
        earlier_s = own_s - delay_s
        first = np.clip(np.searchsorted(own_s, earlier_s, side="right") - 1, 0, len(own) - 2)
        before, after = own[first], own[first + 1]
        spans_s = own_s[first + 1] - own_s[first]  # 0 of a time that comes twice
        shares = np.divide(earlier_s - own_s[first], spans_s, out=np.zeros(len(own)), where=spans_s > 0.0)
        moved = before + shares[:, None, None] * (after - before)
        moved[:, :3, :3] = blended(before[:, :3, :3], after[:, :3, :3], shares)
        delayed_poses[frames.start : frames.stop] = moved
    return delayed_poses


def found_delay_s(
    psnr_db: Callable[[float], float],  # of frames predicted with a delay
    times_s: FloatArray,  # [F]
    ranges: Sequence[range],
) -> float:
    """The delay with which frames are predicted best; 0 where times repeat, and where none is clearly better."""
    steps_s = np.concatenate([np.diff(times_s[frames.start : frames.stop]) for frames in ranges])
    if not len(steps_s) or steps_s.min() <= 0.0:
        return 0.0
    scores: dict[float, float] = {}

    def psnr_of(delay_s: float) -> float:
        if abs(delay_s) > MOST_S:
            return -np.inf
        if delay_s not in scores:
            scores[delay_s] = psnr_db(delay_s)
        return scores[delay_s]

    best_s, usual_s = 0.0, float(np.median(steps_s))
    for step_s in usual_s * np.array(STEPS):
        for onwards_s in (float(step_s), -float(step_s)):
            while psnr_of(best_s + onwards_s) > psnr_of(best_s):
                best_s += onwards_s
    gain_db, loss_db = (psnr_of(best_s) - psnr_of(other_s) for other_s in (0.0, -best_s))
    is_clear = gain_db >= LEAST_GAIN_DB and loss_db >= LEAST_LOSS_OF_OPPOSITE * gain_db
    return best_s if is_clear and abs(best_s) >= LEAST_STEPS * usual_s else 0.0
