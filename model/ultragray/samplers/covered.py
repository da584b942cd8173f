"""Random poses within the region that the base poses cover."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from ultragray.contract import kind_field
from ultragray.errors import InvalidArgument
from ultragray.probe import FloatArray, Probe
from ultragray.samplers.rotations import about_axes, blended, random_directions
from ultragray.samplers.sampler import MAX_DRAWN, DrawnSampler, count_field, seed_field

MAX_BASE_POSES = 10_000  # all are compared with all
LARGEST_GAP = 4.0  # in median lengths of the links


@dataclass(frozen=True)
class CoveredSampler(DrawnSampler):
    """`count` poses, uniform within the region that the base poses cover.

    How far apart two poses are is the mean distance of the corresponding corners of their image planes, mm, so that
    a turn counts by what it moves. The shortest links that join all base poses (a minimum spanning tree) say which are
    neighbours; links longer than 4 times their median are gaps between sweeps and not covered. A pose is drawn by its
    place on the links, uniform in their length: the blend of the two neighbours there (positions linear, orientations
    by slerp), shifted by a step that is uniform in the ball whose radius is the neighbours' distance in position, and
    turned about a random axis by an angle uniform up to the angle between them. Raises InvalidArgument.
    """

    count: int = count_field(high=MAX_DRAWN)
    seed: int = seed_field()
    kind: Literal["covered"] = kind_field("covered")

    def _drawn(self, base: FloatArray, probe: Probe) -> FloatArray:
        if len(base) < 2:
            raise InvalidArgument("sampler covered needs at least two base poses, got one", field="kind")
        if len(base) > MAX_BASE_POSES:
            raise InvalidArgument(
                f"sampler covered takes at most {MAX_BASE_POSES:,} base poses, got {len(base):,}", field="kind"
            )
        corners = np.einsum("pij,kj->pki", base[:, :3, :3], probe.corners_mm()) + base[:, None, :3, 3]  # [P, K, 3] mm
        links, lengths = _shortest_links(corners.tobytes(), len(corners))
        lengths = np.where(lengths > LARGEST_GAP * np.median(lengths), 0.0, lengths)
        ends = np.cumsum(lengths)
        if not ends[-1] > 0.0:
            raise InvalidArgument("sampler covered needs base poses that differ, got the same ones", field="kind")
        random = np.random.default_rng(self.seed)
        places = np.searchsorted(ends, random.uniform(0.0, ends[-1], self.count), side="right")
        links = links[np.minimum(places, np.flatnonzero(lengths)[-1])]
        first, second = base[links[:, 0]], base[links[:, 1]]
        shares = random.uniform(size=self.count)
        made = np.tile(np.eye(4), (self.count, 1, 1))
        steps = second[:, :3, 3] - first[:, :3, 3]
        made[:, :3, 3] = first[:, :3, 3] + shares[:, None] * steps
        made[:, :3, :3] = blended(first[:, :3, :3], second[:, :3, :3], shares)
        radii = np.linalg.norm(steps, axis=1) * np.cbrt(random.uniform(size=self.count))
        made[:, :3, 3] += radii[:, None] * random_directions(random, self.count)
        turns = _angles_rad(first, second) * random.uniform(size=self.count)
        made[:, :3, :3] = made[:, :3, :3] @ about_axes(random_directions(random, self.count), turns)
        return made


@lru_cache(1)  # the same for all blocks
def _shortest_links(packed: bytes, count: int) -> tuple[np.ndarray, FloatArray]:  # [P, K, 3] -> [P-1, 2], [P-1] mm
    """Prim's algorithm: the tree grows by the pose nearest to it. `packed`: the corners, float64; none is changed."""
    corners = np.frombuffer(packed).reshape(count, -1, 3)
    links, lengths = np.zeros((count - 1, 2), np.int64), np.zeros(count - 1)
    waiting, nearest, newest = np.arange(1, count), np.zeros(count - 1, np.int64), 0
    distances = np.full(count - 1, np.inf)
    for place in range(count - 1):
        from_newest = np.linalg.norm(corners[waiting] - corners[newest], axis=2).mean(axis=1)
        closer = from_newest < distances
        distances, nearest = np.where(closer, from_newest, distances), np.where(closer, newest, nearest)
        chosen = int(distances.argmin())
        newest = int(waiting[chosen])
        links[place], lengths[place] = (nearest[chosen], newest), distances[chosen]
        waiting, nearest = np.delete(waiting, chosen), np.delete(nearest, chosen)
        distances = np.delete(distances, chosen)
    return links, lengths


def _angles_rad(first: FloatArray, second: FloatArray) -> FloatArray:  # [C, 4, 4] both -> [C]
    half_chords = np.linalg.norm(first[:, :3, :3] - second[:, :3, :3], axis=(1, 2)) / np.sqrt(8.0)
    angles: FloatArray = 2.0 * np.arcsin(np.clip(half_chords, 0.0, 1.0))
    return angles
