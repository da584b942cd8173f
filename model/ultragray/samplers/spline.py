"""Evenly spaced poses on a smooth path."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ultragray.contract import described, kind_field
from ultragray.errors import InvalidArgument
from ultragray.pose import rotation_angles_deg
from ultragray.probe import FloatArray, Probe
from ultragray.samplers.rotations import blended
from ultragray.samplers.sampler import MAX_POSES, Sampler, count_field

SMALLEST_STEP_MM, SMALLEST_TURN_DEG = 1e-9, 1e-6


@dataclass(frozen=True)
class SplineSampler(Sampler):
    """Poses on a path through the base poses in their order: `count` of them, or one every `spacing_mm`.

    Positions lie on the natural cubic spline (continuous to its second derivative) over the length of the chords;
    orientations go from base pose to base pose on the shortest way at even speed (slerp). Both ends are base poses
    where `count` is above 1; with `spacing_mm` the last one is reached where the length allows it. Spacing is measured
    along the chords. Poses that repeat count once. Raises InvalidArgument.
    """

    count: int | None = count_field(None)
    spacing_mm: float | None = described("Instead of count: distance along the path.", None, above=0.0, high=1000.0)
    kind: Literal["spline"] = kind_field("spline")

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.count is None) == (self.spacing_mm is None):
            raise InvalidArgument("exactly one of count and spacing_mm must be given", field="count")

    def _made(self, base: FloatArray, probe: Probe) -> FloatArray:
        knots = _without_repetitions(base)
        if len(knots) < 2:
            raise InvalidArgument("sampler spline needs at least two different base poses, got one", field="kind")
        lengths = np.linalg.norm(np.diff(knots[:, :3, 3], axis=0), axis=1)
        at = np.concatenate([[0.0], np.cumsum(lengths)])
        places = self._places(float(at[-1]))
        segments = np.clip(np.searchsorted(at, places, side="right") - 1, 0, len(lengths) - 1)
        shares = (places - at[segments]) / lengths[segments]
        made = np.tile(np.eye(4), (len(places), 1, 1))
        made[:, :3, 3] = _natural_cubic(knots[:, :3, 3], lengths, segments, shares)
        made[:, :3, :3] = blended(knots[segments, :3, :3], knots[segments + 1, :3, :3], shares)
        return made

    def _places(self, length_mm: float) -> FloatArray:  # [C]
        if self.count is not None:
            return np.linspace(0.0, length_mm, self.count)
        assert self.spacing_mm is not None
        steps = min(length_mm / self.spacing_mm + 1e-9, 10.0 * MAX_POSES)
        self._require_few(math.floor(steps) + 1, "spacing_mm")
        every: FloatArray = np.minimum(self.spacing_mm * np.arange(math.floor(steps) + 1), length_mm)
        return every


def _without_repetitions(base: FloatArray) -> FloatArray:  # [P, 4, 4] -> [K, 4, 4]
    kept = [0]
    for place in range(1, len(base)):
        last = base[kept[-1]]
        if np.linalg.norm(base[place, :3, 3] - last[:3, 3]) > SMALLEST_STEP_MM:
            kept.append(place)
        elif rotation_angles_deg(base[place][None], last[None])[0, 0] > SMALLEST_TURN_DEG:
            raise InvalidArgument(
                f"sampler spline needs base poses that move on: {kept[-1]} and {place} differ in orientation only",
                field="kind",
            )
    return base[kept]


def _natural_cubic(
    values: FloatArray, lengths: FloatArray, segments: np.ndarray, shares: FloatArray
) -> FloatArray:  # [K, 3], [K-1], [C], [C] -> [C, 3]
    """The natural cubic spline through the values over knots that are `lengths` apart."""
    second = _second_derivatives(values, lengths)
    length, share = lengths[segments, None], shares[:, None]
    rest = 1.0 - share
    straight = rest * values[segments] + share * values[segments + 1]
    bend = (rest**3 - rest) * second[segments] + (share**3 - share) * second[segments + 1]
    curve: FloatArray = straight + length**2 / 6.0 * bend
    return curve


def _second_derivatives(values: FloatArray, lengths: FloatArray) -> FloatArray:  # [K, 3], [K-1] -> [K, 3]
    """Of the spline at its knots, 0 at both ends: a tridiagonal system, solved by elimination."""
    second = np.zeros_like(values)
    slopes = np.diff(values, axis=0) / lengths[:, None]
    jumps = 6.0 * np.diff(slopes, axis=0)  # [K-2, 3]
    above = np.zeros(len(values))
    for knot in range(1, len(values) - 1):
        before, after = lengths[knot - 1], lengths[knot]
        pivot = 2.0 * (before + after) - before * above[knot - 1]
        above[knot] = after / pivot
        second[knot] = (jumps[knot - 1] - before * second[knot - 1]) / pivot
    for knot in range(len(values) - 2, 0, -1):
        second[knot] -= above[knot] * second[knot + 1]
    return second
