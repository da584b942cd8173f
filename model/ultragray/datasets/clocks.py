"""Times of images and poses: the pose at the time of an image, what is wrong with the clocks, and how far they differ.

A tracker and a scanner have clocks of their own, and a picture takes its time from the transducer to the recorder: by
this delay its stamp is too late, and the pose at its stamp is another one than that at which it was taken.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import blended
from ultragray.learn.sweep import IntArray, frame_list

NS_PER_S, NS_PER_MS = 1_000_000_000, 1_000_000
LONGEST_STEP_S = 2.0  # from one frame or row to the next: numbers that go further are no seconds
MAX_GAP_NS = 200_000_000  # a hand that moves on goes another way within a longer time
LEAST_TO_AND_FRO, SMALLEST_TO_AND_FRO_MM = 8, 1.0
MAX_DELAY_MS = 1e12  # a clock that was never set is decades off

BoolArray: TypeAlias = npt.NDArray[np.bool_]


def parse_delay_ns(text: str | None) -> int:
    """Nanoseconds of a delay in milliseconds; None: none. Raises InvalidArgument."""
    try:
        delay_ms = float(text or 0.0)
    except ValueError:
        delay_ms = math.nan
    if not abs(delay_ms) <= MAX_DELAY_MS:
        raise InvalidArgument(f"image_delay_ms must be milliseconds, got {str(text)[:40]!r}", field="image_delay_ms")
    return round(delay_ms * NS_PER_MS)


def delay_note(delay_ns: int) -> tuple[str, ...]:
    """What a person is told of a delay that was asked for."""
    return (f"poses are those {delay_ns / NS_PER_MS:g} ms before the stamps of the images",) if delay_ns else ()


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Poses over time, ascending; one that is fixed has no times."""

    times_ns: IntArray  # [P], of a fixed one [0]
    poses: FloatArray  # [P, 4, 4] mm, of a fixed one [1, 4, 4]

    def fixed(self) -> PoseTrack:
        """The last pose alone, for all times."""
        return PoseTrack(self.times_ns[:0], self.poses[-1:])

    def at(self, times_ns: IntArray, max_gap_ns: int = MAX_GAP_NS) -> tuple[FloatArray, BoolArray]:  # [F, 4, 4], [F]
        """The pose at each time, and whether it is known: at the time of a pose, or between two close enough.

        The position is linear between the poses before and after, the orientation by slerp.
        """
        if not len(self.times_ns):
            return np.repeat(self.poses, len(times_ns), axis=0), np.ones(len(times_ns), bool)
        after = np.minimum(np.searchsorted(self.times_ns, times_ns), len(self.times_ns) - 1)
        exact = self.times_ns[after] == times_ns
        before = np.where(exact, after, np.maximum(after - 1, 0))
        gaps = self.times_ns[after] - self.times_ns[before]
        known = exact | ((self.times_ns[before] < times_ns) & (times_ns < self.times_ns[after]) & (gaps <= max_gap_ns))
        shares = np.where(known, (times_ns - self.times_ns[before]) / np.maximum(gaps, 1), 0.0)
        first, second = self.poses[before], self.poses[after]
        found = first.copy()
        found[:, :3, :3] = blended(first[:, :3, :3], second[:, :3, :3], shares)
        found[:, :3, 3] += shares[:, None] * (second[:, :3, 3] - first[:, :3, 3])
        return found, known


def goes_to_and_fro_mm(positions: FloatArray) -> float:  # [N, 3]
    """How far a probe jumps from pose to pose, and back with the next; 0: it does not.

    Two trackers that are recorded as one tell their poses in turn. A hand that shakes by itself does not come back to
    where it was.
    """
    if len(positions) < LEAST_TO_AND_FRO:
        return 0.0
    one, two = (float(np.median(np.linalg.norm(positions[apart:] - positions[:-apart], axis=1))) for apart in (1, 2))
    return one if one > SMALLEST_TO_AND_FRO_MM and two < one / 2 else 0.0


def times_of_all(times_s: FloatArray) -> tuple[FloatArray | None, tuple[str, ...]]:  # [F]
    """The times where every frame has one, else None, and what a person is told of that."""
    missing = int((~np.isfinite(times_s)).sum())
    if not missing:
        return times_s, ()
    return None, (
        f"{missing} of {len(times_s)} frames {'has' if missing == 1 else 'have'} no time that can be read: those of "
        "the others are not used either, so that neither a delay of the images nor odd clocks are found",
    )


def poses_before(
    poses: FloatArray,  # [F, 4, 4]
    times_s: FloatArray | None,  # [F]
    delay_ns: int,
    path: Path,
) -> tuple[FloatArray, BoolArray]:  # [F, 4, 4], [F]
    """The poses of frames a delay before their times, and which are known.

    They are taken between those of the frames, which lie at most 0.2 s or three usual steps apart. Raises
    InvalidArgument where the frames have no times.
    """
    if times_s is None:
        raise InvalidArgument(
            f"image_delay_ms is for recordings with times: {path.name} has none for every frame", field="image_delay_ms"
        )
    if not len(times_s):
        return poses, np.zeros(0, bool)
    times_ns = np.round((times_s - times_s.min()) * NS_PER_S).astype(np.int64)
    ascending, places = np.unique(times_ns, return_index=True)
    usual_ns = int(np.median(np.diff(ascending))) if len(ascending) > 1 else 0
    return PoseTrack(ascending, poses[places]).at(times_ns - delay_ns, max(MAX_GAP_NS, 3 * usual_ns))


def clock_warnings(times_s: FloatArray, numbers: IntArray) -> Iterator[str]:  # [F] both
    """Steps back, stamps that come twice, and steps too long for seconds."""
    steps = np.diff(times_s)
    usual_s = float(np.median(steps / np.diff(numbers).clip(min=1))) if len(steps) else 0.0
    if usual_s > LONGEST_STEP_S:
        yield f"the time goes on by {usual_s:.6g} s from frame to frame: another unit, where seconds are expected?"
    if len(back := np.flatnonzero(steps < 0)):
        yield (
            f"the time steps back at frame {frame_list(numbers[back + 1])}, by up to {-steps.min() * 1000:.6g} ms: "
            "another clock, or frames in a wrong order?"
        )
    if len(same := np.flatnonzero(steps == 0)):
        yield f"frames {frame_list(numbers[same + 1])} have the time of the frame before: stamps that come twice"


# The delay of the images, estimated: with the right one, images that look alike were taken in places that lie close
# together. For each delay the distances of the planes in pairs of frames are divided into bins; what the bins leave
# unexplained of the variance of the images' differences (one minus the correlation ratio, Roche et al. 1998) is least
# at the right delay. A probe that goes evenly one way tells nothing; one that turns back, halts or hastens does.


MAX_LAG_S, LAG_STEP_S = 0.5, 0.01
BINS = 40
LEAST_FRAMES, MAX_FRAMES = 20, 240
CLEAR = 0.75  # of what is unexplained without a delay, and at the usual one: less tells one
LEAST_GAIN = 0.04  # of the variance: tissue that changes faster here than there gains less by a false delay


@dataclass(frozen=True)
class DelayEstimate:
    """How much later than its pose a frame is stamped."""

    delay_ms: float
    unexplained: float  # of the variance of the images, with this delay
    without: float  # the same with none


def estimate_delay(
    thumbnails: FloatArray,  # [F, P] of length 1
    corners: FloatArray,  # [F, K, 3] mm
    times_s: FloatArray,  # [F] ascending
) -> DelayEstimate | None:
    """The delay of images to the poses of their frames; None where the motion does not tell it."""
    span_s = float(times_s[-1] - times_s[0]) if len(times_s) else 0.0
    most_s = min(MAX_LAG_S, span_s / 5)
    if span_s <= 0:
        return None
    inner = np.flatnonzero((times_s >= times_s[0] + most_s) & (times_s <= times_s[-1] - most_s))
    if len(inner) < LEAST_FRAMES:
        return None
    inner = inner[np.linspace(0, len(inner) - 1, min(len(inner), MAX_FRAMES)).round().astype(int)]
    first, second = np.triu_indices(len(inner), 1)
    looks = thumbnails[inner]
    differences = 1.0 - (looks @ looks.T)[first, second]
    if (variance := float(differences.var())) < 1e-9:
        return None
    flat = corners.reshape(len(corners), -1)
    step_s = min(LAG_STEP_S, most_s / 10)
    lags = step_s * np.arange(-round(most_s / step_s), round(most_s / step_s) + 1)
    edges = np.linspace(0, len(first), BINS + 1).astype(int)[:-1]
    counts = np.diff([*edges, len(first)])
    unexplained = np.empty(len(lags))
    for place, lag in enumerate(lags):
        at = np.stack([np.interp(times_s[inner] - lag, times_s, column) for column in flat.T], axis=1)
        squares = np.square(at).sum(axis=1)
        distances = (squares[:, None] + squares - 2.0 * at @ at.T)[first, second]
        ordered = differences[np.argsort(distances, kind="stable")]
        sums, second_sums = np.add.reduceat(ordered, edges), np.add.reduceat(ordered**2, edges)
        unexplained[place] = (second_sums - sums**2 / counts).sum() / (len(first) * variance)
    best, none = int(unexplained.argmin()), len(lags) // 2
    usual_s = float(np.median(np.diff(times_s)))
    is_clear = unexplained[best] < min(
        CLEAR * min(unexplained[none], float(np.median(unexplained))), unexplained[none] - LEAST_GAIN
    )
    if best in (0, len(lags) - 1) or not is_clear:
        return None
    before, here, after = unexplained[best - 1 : best + 2]
    shift = 0.5 * (before - after) / max(before - 2 * here + after, 1e-12)
    delay_s = float(lags[best] + step_s * np.clip(shift, -1, 1))
    if abs(delay_s) < max(LAG_STEP_S, 0.25 * usual_s):
        return None
    return DelayEstimate(delay_s * 1000, float(unexplained[best]), float(unexplained[none]))
