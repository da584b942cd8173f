"""The neighbours of each frame of a sweep, across its gaps, and the ends beyond which there are none."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ultragray.datasets.sweep import IntArray, Sweep
from ultragray.pose import rotation_angles_deg
from ultragray.probe import FloatArray

ALIKE_DEG = 20.0  # turned farther, a frame shows the same things from another side
LEAST_ACROSS = 0.5  # of the way to a neighbour that leads across the image plane; else it lies beside
CROSSING = 0.25  # of the height of the higher corner over a plane, on its other side: there the frames cross
EXTENT = 0.25  # lengths of the scan lines, which the space beyond an end is filled to


@dataclass(frozen=True, eq=False)
class Neighbours:
    """E pairs of neighbouring frames and K ends of a sweep."""

    pairs: IntArray  # [E, 2] places of frames
    gaps_mm: FloatArray  # [E] mean distance of the corners of the two images
    ends: IntArray  # [K] places of frames with none on one side
    outward: FloatArray  # [K] +1 where that side lies along the elevation axis, −1 where against it
    spacing_mm: float  # median gap; 0 where there is no pair
    nearest_mm: float  # beyond the ends: a spacing, or a pixel of a probe held still
    extent_mm: float  # the farthest

    def without_ends(self) -> Neighbours:
        """The gaps alone."""
        return replace(self, ends=self.ends[:0], outward=self.outward[:0])

    @property
    def weights(self) -> FloatArray:  # [E + K], their sum 1
        """The share of each gap and each end in the space around the frames.

        A gap counts by its length, but never less than the usual one; an end as one gap for each doubling of the
        distance: the farther, the less is known.
        """
        usual = self.spacing_mm or 1.0
        gaps = np.maximum(self.gaps_mm, usual) / usual
        ends = np.full(len(self.ends), self.doublings)
        weights = np.concatenate([gaps, ends])
        shares: FloatArray = weights / weights.sum()
        return shares

    @property
    def doublings(self) -> float:
        """Of the distance from an end, from the nearest views to the extent."""
        return max(1.0, math.log2(self.extent_mm / self.nearest_mm))

    def beyond_mm(self, shares: FloatArray) -> FloatArray:
        """Distances from an end, for shares from 0 to 1 of the way there in doublings."""
        return self.nearest_mm * (self.extent_mm / self.nearest_mm) ** shares


def neighbours_of(sweep: Sweep) -> Neighbours:
    """For each frame the nearest one on either side of its plane, of those that are turned alike and not beside it.

    A probe that is turned in place has frames that cross: there the two nearest are neighbours. A frame without any is
    paired with itself, so that each takes part.
    """
    corners, middles = sweep.corners_mm(), sweep.corners_mm().mean(axis=1)  # [F, K, 3], [F, 3]
    pairs: dict[tuple[int, int], float] = {}
    alone: list[tuple[int, int]] = []
    extent_mm = EXTENT * sweep.probe.scan_line_length_mm
    breadth_mm = float(np.linalg.norm(corners[0] - middles[0], axis=-1).max())
    for place, pose in enumerate(sweep.poses):
        offsets = corners - corners[place]  # [F, K, 3]
        distances = np.linalg.norm(offsets, axis=-1).mean(axis=1)
        across = (offsets @ pose[:3, 1]).mean(axis=1)
        beside = np.linalg.norm(middles - middles[place], axis=1) > np.hypot(breadth_mm, across)
        alike = rotation_angles_deg(pose[None], sweep.poses)[0] < ALIKE_DEG
        candidates = alike & ~beside & (distances > 0.0)
        nearest = np.flatnonzero(candidates)[np.argsort(distances[candidates], kind="stable")[:2]]
        if len(nearest) and _crosses(offsets[nearest[0]] @ pose[:3, 1]):
            found = nearest.tolist()
        else:
            found = []
            for side in (1, -1):
                ahead = side * across
                near = np.flatnonzero(candidates & (ahead > LEAST_ACROSS * distances))
                if len(near):
                    found.append(int(near[distances[near].argmin()]))
                elif not ((ahead > 0) & (ahead < extent_mm) & ~beside).any():
                    alone.append((place, side))
        pairs |= {(min(place, other), max(place, other)): float(distances[other]) for other in found}
    used = {place for pair in pairs for place in pair}
    spacing_mm = float(np.median(list(pairs.values()))) if pairs else 0.0
    pairs |= {(place, place): 0.0 for place in range(len(sweep)) if place not in used}
    ends = np.array(alone, dtype=np.int64).reshape(-1, 2)
    return Neighbours(
        pairs=np.array(list(pairs), dtype=np.int64).reshape(-1, 2),
        gaps_mm=np.array(list(pairs.values())),
        ends=ends[:, 0],
        outward=ends[:, 1].astype(np.float64),
        spacing_mm=spacing_mm,
        nearest_mm=min(spacing_mm or max(sweep.pixel_mm), extent_mm),
        extent_mm=extent_mm,
    )


def _crosses(heights_mm: FloatArray) -> bool:  # [K] of the corners of a frame over the plane of another
    """Whether the planes cross within the images, about evenly: not as frames of a tilt do, whose faces meet."""
    low, high = float(heights_mm.min()), float(heights_mm.max())
    return min(-low, high) > CROSSING * max(-low, high)
