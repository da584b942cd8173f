"""Estimates from the tracked path alone: where a new sweep begins, the tracker's noise, and the path without it.

A hand or a robot moves a probe smoothly, while a tracker's errors differ from frame to frame. A pose has six
coordinates: the position of the probe's origin along the sweep's mean axes, and the turn from its mean orientation.
The second differences of each are the sum of two independent parts: those of the path, with variance q, and those of
the tracker's error, D·e with variance r of e. The two parts have different spectra, so q and r are found by maximum
likelihood; the path is then the posterior mean. A tracker's errors have the same size along all three axes, but a probe
that moves unevenly along its path looks noisy in that direction: the smallest r of the three is taken for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ultragray.datasets.sweep import Sweep, corner_distances_mm
from ultragray.evaluation.compounding import mean_axes
from ultragray.probe import FloatArray
from ultragray.samplers.rotations import rotations_of, turns_of
from ultragray.training.poses.second_differences import likelihood_terms, smoothed

JUMP = 6.0  # median steps: a longer step begins a new sweep
LEAST_FRAMES = 5  # of a sweep: fewer are not a path
RATIOS = 10.0 ** np.arange(-6.0, 6.01, 0.25)  # of the variances q/r that are tried
TINY = 1e-300  # a variance whose logarithm is finite
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
    """The tracker's errors, estimated from the path alone; 0 where the path is too short for an estimate."""
    position, turn = _Likelihood.of(_coordinates(poses, ranges), ranges).noise_variances()
    return TrackerNoise(float(np.sqrt(position)), float(np.sqrt(turn)))


def without_noise(poses: FloatArray, ranges: Sequence[range]) -> FloatArray:  # [F, 4, 4] mm -> [F, 4, 4] mm
    """The likeliest path of each sweep."""
    coordinates = _coordinates(poses, ranges)
    likelihood = _Likelihood.of(coordinates, ranges)
    noise = np.repeat(likelihood.noise_variances(), 3)
    cleaned = coordinates.copy()
    for number in range(_NUMBERS):
        if noise[number] == 0.0:
            continue
        ratio = likelihood.best_ratio(number, noise[number])
        for frames in _long_enough(ranges):
            cleaned[frames, number] = smoothed(coordinates[frames, number], ratio)
    found = poses.copy()
    for frames in ranges:
        axes = mean_axes(poses[frames])
        found[frames, :3, 3] = cleaned[frames, :3] @ axes.T
        found[frames, :3, :3] = axes @ rotations_of(np.radians(cleaned[frames, 3:]))
    return found


def _coordinates(poses: FloatArray, ranges: Sequence[range]) -> FloatArray:  # [F, 6] mm, degrees
    found = np.zeros((len(poses), _NUMBERS))
    for frames in ranges:
        axes = mean_axes(poses[frames])
        found[frames, :3] = poses[frames, :3, 3] @ axes
        found[frames, 3:] = np.degrees(turns_of(axes.T @ poses[frames, :3, :3]))
    return found


def _long_enough(ranges: Sequence[range]) -> list[range]:
    return [frames for frames in ranges if len(frames) >= LEAST_FRAMES]


@dataclass(frozen=True, eq=False)
class _Likelihood:
    """How likely the second differences of each coordinate are, for each of RATIOS q/r.

    Their covariance is r·(q/r·1 + D·Dᵀ).
    """

    count: int  # of second differences
    log_determinants: FloatArray  # [R], without r
    squares: FloatArray  # [R, 6] of the differences, weighted by the inverse, without r

    @classmethod
    def of(cls, coordinates: FloatArray, ranges: Sequence[range]) -> _Likelihood:  # [F, 6]
        bends = [np.diff(coordinates[frames], 2, axis=0) for frames in _long_enough(ranges)]
        terms = [likelihood_terms(some, RATIOS) for some in bends]
        nothing = np.zeros(len(RATIOS)), np.zeros((len(RATIOS), _NUMBERS))
        log_determinants, squares = (np.sum(part, axis=0) for part in zip(nothing, *terms, strict=True))
        return cls(sum(map(len, bends)), log_determinants, squares)

    def noise_variances(self) -> tuple[float, float]:
        """The likeliest r: of position, mm², and of turn, degrees²."""
        variances = self.squares / max(self.count, 1)
        costs = self.count * np.log(np.maximum(variances, TINY)) + self.log_determinants[:, None]
        best = variances[costs.argmin(axis=0), np.arange(_NUMBERS)]
        return float(best[:3].min()), float(best[3:].min())

    def best_ratio(self, number: int, noise: float) -> float:
        """The likeliest q/r of one coordinate where r is `noise`."""
        return float(RATIOS[(self.log_determinants + self.squares[:, number] / noise).argmin()])
