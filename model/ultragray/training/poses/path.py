"""The path of the probe: where one sweep ends and the next begins, how much the tracker shakes, and the path without.

A hand or a robot moves a probe smoothly; a tracker's errors differ from frame to frame. Of each of the six numbers of a
pose (position of the probe's origin along the sweep's mean axes, turn from its mean orientation) the second differences
are therefore a sum of two parts: those of the path, independent with variance q, and those of the tracker's error,
D·e with variance r of e. Their spectra differ, so that q and r follow from the data by maximum likelihood; the path is
then the posterior mean. A tracker errs alike along all axes: the least r of three is taken, since a probe that does not
move evenly along its path looks like an error there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ...datasets.sweep import Sweep, corner_distances_mm
from ...evaluation.compounding import mean_axes
from ...probe import FloatArray
from .motion import rotations_of, turn_vectors_deg

JUMP = 6.0  # times the median step: there a new sweep begins
LEAST_FRAMES = 5  # of a sweep: fewer tell nothing of a path
STEPS = 10.0 ** np.arange(-6.0, 6.01, 0.25)  # tried ratios of variances
GOOD_MM, GOOD_DEG = 0.2, 0.2  # a tracker's error below these, standard deviation along an axis, is left alone
_NUMBERS = 6


@dataclass(frozen=True)
class TrackerNoise:
    """Standard deviations, along each axis, of a tracker's errors from frame to frame."""

    position_mm: float
    turn_deg: float

    @property
    def is_small(self) -> bool:
        """Whether the poses are good as they are."""
        return self.position_mm < GOOD_MM and self.turn_deg < GOOD_DEG


def sweep_ranges(sweep: Sweep) -> list[range]:
    """The places of the frames of each sweep, in order: a new one begins where the path jumps."""
    corners = sweep.corners_mm()
    steps = corner_distances_mm(corners[1:], corners[:-1])
    starts = [0]
    moves = steps[steps > 0.0]  # a tracker may repeat its last pose
    for place in np.flatnonzero(steps > JUMP * np.median(moves)) + 1 if len(moves) else ():
        if place - starts[-1] >= LEAST_FRAMES and len(sweep) - place >= LEAST_FRAMES:
            starts.append(int(place))
    return [range(first, last) for first, last in pairwise([*starts, len(sweep)])]


def tracker_noise(poses: FloatArray, ranges: Sequence[range]) -> TrackerNoise:  # [F, 4, 4] mm
    """The errors that the path itself shows; 0 where it is too short to tell."""
    position, turn = _noise_variances(_coordinates(poses, ranges), ranges)
    return TrackerNoise(float(np.sqrt(position)), float(np.sqrt(turn)))


def without_noise(poses: FloatArray, ranges: Sequence[range]) -> FloatArray:  # [F, 4, 4] mm -> [F, 4, 4] mm
    """The likeliest path of each sweep."""
    coordinates = _coordinates(poses, ranges)
    noise = np.repeat(_noise_variances(coordinates, ranges), 3)
    cleaned = coordinates.copy()
    for number in range(_NUMBERS):
        if noise[number] == 0.0:
            continue
        _, path = _likeliest([_bends(coordinates, frames, number) for frames in ranges], noise[number])
        for frames in ranges:
            if len(frames) >= LEAST_FRAMES:
                bends = _second_differences(len(frames))
                weight = np.eye(len(frames)) + noise[number] / path * bends.T @ bends
                cleaned[frames, number] = np.linalg.solve(weight, coordinates[frames, number])
    found = poses.copy()
    for frames in ranges:
        axes = mean_axes(poses[frames])
        found[frames, :3, 3] = cleaned[frames, :3] @ axes.T
        found[frames, :3, :3] = axes @ rotations_of(cleaned[frames, 3:])
    return found


def _coordinates(poses: FloatArray, ranges: Sequence[range]) -> FloatArray:  # [F, 6] mm, degrees
    found = np.zeros((len(poses), _NUMBERS))
    for frames in ranges:
        axes = mean_axes(poses[frames])
        found[frames, :3] = poses[frames, :3, 3] @ axes
        found[frames, 3:] = turn_vectors_deg(axes.T @ poses[frames, :3, :3])
    return found


def _noise_variances(coordinates: FloatArray, ranges: Sequence[range]) -> tuple[float, float]:
    """Of position, mm², and turn, degrees²."""
    each = [_likeliest([_bends(coordinates, frames, number) for frames in ranges])[0] for number in range(_NUMBERS)]
    return min(each[:3]), min(each[3:])


def _bends(coordinates: FloatArray, frames: range, number: int) -> FloatArray:
    return np.diff(coordinates[frames, number], 2) if len(frames) >= LEAST_FRAMES else np.zeros(0)


def _second_differences(count: int) -> FloatArray:  # [count − 2, count]
    rows = np.arange(count - 2)
    found = np.zeros((count - 2, count))
    found[rows, rows], found[rows, rows + 1], found[rows, rows + 2] = 1.0, -2.0, 1.0
    return found


def _likeliest(bends: Sequence[FloatArray], noise: float | None = None) -> tuple[float, float]:
    """r and q of the likeliest model of second differences; r is given, or found too."""
    spectra = []
    for some in bends:
        if len(some):
            differences = _second_differences(len(some) + 2)
            eigenvalues, vectors = np.linalg.eigh(differences @ differences.T)
            spectra.append((eigenvalues, (vectors.T @ some) ** 2))
    if not spectra or sum(float(power.sum()) for _, power in spectra) == 0.0:
        return 0.0 if noise is None else noise, 1e-12
    eigenvalues, power = (np.concatenate(part) for part in zip(*spectra, strict=True))
    best = (np.inf, 0.0, 1.0)
    for ratio in STEPS:
        shape = ratio + eigenvalues
        variance = float((power / shape).mean()) if noise is None else noise
        cost = float((np.log(variance * shape) + power / (variance * shape)).sum())
        best = min(best, (cost, variance, ratio * variance))
    return best[1], best[2]
