"""The choice of training frames that a calibration leaves out: a mix of gaps, ends and tilts."""

from __future__ import annotations

import math

import numpy as np

from ultragray.datasets.sweep import IntArray, Sweep
from ultragray.pose import rotation_angles_deg
from ultragray.probe import FloatArray

# Stretches of the sweep's path, as shares of its length: first and last, then gaps of several widths.
STRETCHES = ((0.0, 0.06), (0.20, 0.23), (0.34, 0.39), (0.48, 0.57), (0.68, 0.69), (0.89, 1.0))
TURNED = (0.73, 0.83)  # in which frames are left out by their tilt instead
TURNED_SHARE = 1 / 3
LEAST_TILT_DEG = 2.0  # smaller differences are unsteadiness of the hand
SINGLE_EVERY = 12  # of the frames that are left
LEAST_KEPT = 4
MAX_SHARE = 0.45
LEAST_HELD_OUT = 3  # fewer tell nothing


def held_out_frames(sweep: Sweep) -> IntArray:  # [H] places, ascending
    """Frames of some stretches of the path, the most tilted ones of another stretch, and single ones; maybe none.

    All frames of a stretch are left out, whichever pass of the probe they come from. At most MAX_SHARE of the frames
    and never more than leave LEAST_KEPT: single frames are given up first, then the last ones of the path.
    """
    along = path_mm(sweep)
    path = along / (float(np.ptp(along)) or 1.0)
    chosen = np.zeros(len(sweep), bool)
    for first, last in STRETCHES:
        chosen |= (path >= first) & (path <= last)
    stretch = np.flatnonzero((path > TURNED[0]) & (path < TURNED[1]) & ~chosen)
    chosen[stretch[_most_tilted(sweep.poses[stretch])]] = True
    stretches = np.flatnonzero(chosen)
    rest = np.flatnonzero(~chosen)
    singles = rest[np.argsort(path[rest], kind="stable")][SINGLE_EVERY // 2 :: SINGLE_EVERY]
    wanted = np.concatenate([stretches[np.argsort(path[stretches], kind="stable")], singles])
    allowed = min(math.floor(MAX_SHARE * len(sweep)), len(sweep) - LEAST_KEPT)
    return np.sort(wanted[: max(allowed, 0)]).astype(np.int64)


def path_mm(sweep: Sweep) -> FloatArray:  # [F], from 0 on
    """The place of each frame along the direction in which the middles of the images spread most."""
    middles = sweep.corners_mm().mean(axis=1)
    offsets = middles - middles.mean(axis=0)
    _, _, directions = np.linalg.svd(offsets, full_matrices=False)
    places: FloatArray = offsets @ directions[0]
    places -= places.min()
    return places


def _most_tilted(poses: FloatArray) -> IntArray:  # [F, 4, 4] -> [≤ F]
    """Those turned farthest to one side of the others, where the orientations differ by LEAST_TILT_DEG or more."""
    if len(poses) < 3:
        return np.zeros(0, np.int64)
    angles = rotation_angles_deg(poses, poses)
    farthest = angles[int(np.unravel_index(angles.argmax(), angles.shape)[0])]
    if farthest.max() < LEAST_TILT_DEG:
        return np.zeros(0, np.int64)
    count = max(1, round(TURNED_SHARE * len(poses)))
    return np.argsort(farthest, kind="stable")[:count].astype(np.int64)
