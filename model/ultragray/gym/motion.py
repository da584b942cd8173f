"""Motions of a probe in its own frame, about the middle of its face."""

from __future__ import annotations

import numpy as np

from ultragray.probe import FloatArray
from ultragray.samplers.rotations import about_axes, random_directions, rotations_of


def moved(pose: FloatArray, shift_mm: FloatArray, turn_deg: FloatArray, pivot_mm: float) -> FloatArray:
    """A pose [4, 4] shifted along and turned about the probe's axes, [3] each: lateral, elevation, axial.

    A turn is an axis times an angle, about the point at depth `pivot_mm` on the probe's axis.
    """
    return _displaced(pose, shift_mm, rotations_of(np.radians(turn_deg)[None])[0], pivot_mm)


def random_motion(
    random: np.random.Generator, pose: FloatArray, most_mm: float, most_deg: float, pivot_mm: float
) -> FloatArray:
    """A pose [4, 4] shifted at random, uniform in a ball, and turned about a random axis by a uniform angle."""
    shift = random_directions(random, 1)[0] * most_mm * random.random() ** (1.0 / 3.0)
    turn = about_axes(random_directions(random, 1), np.radians(most_deg) * random.random(1))[0]
    return _displaced(pose, shift, turn, pivot_mm)


def _displaced(pose: FloatArray, shift_mm: FloatArray, rotation: FloatArray, pivot_mm: float) -> FloatArray:
    pivot = np.array([0.0, 0.0, pivot_mm])
    motion = np.eye(4)
    motion[:3, :3] = rotation
    motion[:3, 3] = shift_mm + pivot - rotation @ pivot
    displaced: FloatArray = pose @ motion
    return displaced
