"""A frame predicted from others: in time, from the same pixels of the two beside it; in space, from what planes show
where they lie nearest to a pixel. Free of torch, since data sets are checked without it (`training.between` does the
same in space for whole batches on a GPU).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray.errors import DatasetInvalid
from ultragray.geometry.probe import FloatArray, ParallelLines, Probe
from ultragray.geometry.scan_conversion import Interpolate, interpolated_frames, pixel_places
from ultragray.learn.sweep import Dataset, IntArray, Sweep, frame_list

ON_PLANE_MM = 1e-6  # distances are at least that: the nearer frame then has all the weight


def line_numbers(probe: Probe) -> tuple[bool | float, ...]:
    """How the C++ kernels find a point on a frame: `FrameLines` without its pixels."""
    lines = probe.lines
    along = lines.direction if isinstance(lines, ParallelLines) else (0.0, 1.0)
    ends = lines.start, lines.span, probe.near_mm, probe.scan_line_length_mm
    return not isinstance(lines, ParallelLines), lines.wrap, *along, *ends, ON_PLANE_MM


def seen_by_frame(
    sweep: Sweep,
    frame: int,
    local: FloatArray,  # [P, 3] mm, in the frame of its probe
    interpolate: Interpolate = interpolated_frames,
) -> tuple[npt.NDArray[np.bool_], FloatArray]:  # [P], [M] of 255
    """Which points fall into an image when projected onto its plane along its normal, and what it shows there."""
    rows, columns = sweep.probe.image_coordinates(local[:, 0], local[:, 2])
    inside = ~np.isnan(rows)
    places = pixel_places(sweep.probe, sweep.images.shape[1:], rows[inside], columns[inside])
    return inside, interpolate(sweep.images, frame, *places)


def blend_by_distance(values: FloatArray, distances_mm: FloatArray) -> FloatArray:  # [2, P] both -> [P]
    """Values of two frames in inverse proportion to the distances, which are infinite where a frame shows nothing.

    NaN where neither shows anything.
    """
    weights = 1.0 / np.maximum(distances_mm, ON_PLANE_MM)
    with np.errstate(invalid="ignore"):
        blend: FloatArray = (weights * values).sum(axis=0) / weights.sum(axis=0)
    return blend


def blend_in_time(before: npt.NDArray[Any], after: npt.NDArray[Any], share: float) -> FloatArray:
    """Values of two frames pixel by pixel, whatever their poses; `share` of the way in time to the second."""
    blend: FloatArray = before + share * (after.astype(np.float64) - before)
    return blend


def frame_times(sweep: Sweep) -> FloatArray:  # [F]
    """Times of the frames in seconds; their numbers where they have none."""
    return sweep.frame_numbers.astype(np.float64) if sweep.times_s is None else sweep.times_s


@dataclass(frozen=True, eq=False)
class NeighboursInTime:
    """The two training frames beside each held-out frame in the same recording."""

    frames: IntArray  # [V, 2] their places among the training frames; at an end of the recording one of them twice
    shares: FloatArray  # [V] of the way in time from the first to the second

    @classmethod
    def of(cls, dataset: Dataset) -> NeighboursInTime:
        """By the times of the frames, by their numbers where some have none, by their places where files differ.

        Raises DatasetInvalid where held-out frames are of another recording than the training frames, and where a
        held-out frame has the time of a training frame.
        """
        train, val = dataset.train, dataset.val
        if (places := dataset.places) is None:
            raise DatasetInvalid(
                f"{dataset.name}: held-out frames are of another recording ({val.source}) than the training frames "
                f"({train.source}): they have no neighbours in time"
            )
        if not dataset.is_one_recording:
            known, targets = np.split(places.astype(np.float64), [len(train)])
        elif train.times_s is None or val.times_s is None:
            known, targets = (part.frame_numbers.astype(np.float64) for part in (train, val))
        else:
            known, targets = train.times_s, val.times_s
        order = np.argsort(known, kind="stable")
        times = known[order]
        if len(twice := np.flatnonzero(np.isin(targets, times))):
            raise DatasetInvalid(
                f"{dataset.name}: held-out frames {frame_list(val.frame_numbers[twice])} have the times of training "
                "frames: they have no neighbours in time"
            )
        after = np.searchsorted(times, targets)
        pairs = np.clip(np.stack([after - 1, after], axis=1), 0, len(times) - 1)  # [V, 2]
        starts, ends = times[pairs].T
        return cls(order[pairs], (targets - starts) / np.where(ends > starts, ends - starts, 1.0) * (ends > starts))

    def frames_of(self, sweep: Sweep) -> npt.NDArray[np.float32]:  # [V, H, W] in [0, 1]
        """The blends of the frames of the training sweep."""
        blends = np.empty((len(self.frames), *sweep.images.shape[1:]), np.float32)
        for blend, (first, second), share in zip(blends, self.frames, self.shares, strict=True):
            blend[:] = blend_in_time(sweep.images[first], sweep.images[second], share) / 255.0
        return blends
