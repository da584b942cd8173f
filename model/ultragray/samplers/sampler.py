"""Samplers: poses for batches, each kind with its settings; one kind a class, found by its name."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from ultragray.contract import Family, described, kind_field
from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.geometry.rotations import about_axes, blended, random_directions, rotation_angles_deg, turn_angles_rad

MAX_POSES = 100_000  # that are made at once
MAX_DRAWN = 100_000_000  # of a batch that is made in shards: 20,000 files of 5,000 frames
BLOCK_POSES = 5_000  # drawn by one generator: a shard of as many frames draws its own poses and no others
MAX_SEED = 2**63 - 1


class Sampler(Family):
    """Makes poses from base poses: those that the caller gives, else the training poses of a scene."""

    __topic__ = "Sampling"
    kind: str

    def poses(self, base: Any, probe: Probe) -> FloatArray:  # [P, 4, 4] -> [C, 4, 4] mm
        """The poses, exact; the same base, probe and sampler give the same.

        Raises InvalidPose, and InvalidArgument where the base has too few poses or more than 100,000 would come out.
        """
        checked = check_poses(base)
        if not len(checked):
            raise InvalidArgument(f"sampler {self.kind} needs base poses, got none", field="kind")
        return check_poses(self._new_poses(checked, probe))

    def _new_poses(self, base: FloatArray, probe: Probe) -> FloatArray:  # [P, 4, 4] -> [C, 4, 4] mm
        raise NotImplementedError

    def _require_few(self, count: float, name: str) -> None:
        if count > MAX_POSES:
            raise InvalidArgument(
                f"{name} {getattr(self, name):g} gives more than the {MAX_POSES:,} poses that can be made", field=name
            )


class DrawnSampler(Sampler):
    """Draws `count` poses at random, block by block, each block by a seed of its own that follows from `seed`.

    A pose depends on its number, the seed and, in the last block, the count: any part can be made without the rest.
    """

    count: int
    seed: int

    @property
    def block_count(self) -> int:
        """The number of blocks; all but the last have BLOCK_POSES poses."""
        return -(-self.count // BLOCK_POSES)

    def block(self, number: int) -> DrawnSampler:
        """The sampler of one block: itself where there is one block only."""
        count = min(BLOCK_POSES, self.count - number * BLOCK_POSES)
        return self.with_draws(count, self.seed if number == 0 else seed_of(self.seed, number, _BLOCKS))

    def with_draws(self, count: int, seed: int) -> DrawnSampler:
        changes: Any = {"count": count, "seed": seed}
        return replace(self, **changes)  # type: ignore[type-var]  # its members are dataclasses

    def require_few(self) -> None:
        """Raises InvalidArgument where the poses are too many to be made at once."""
        if self.count > MAX_POSES:
            raise InvalidArgument(
                f"count {self.count:,} is more than the {MAX_POSES:,} poses that are made at once: more are rendered "
                "in shards, by a render job or by `ultragray render --on`",
                field="count",
            )

    def _new_poses(self, base: FloatArray, probe: Probe) -> FloatArray:
        self.require_few()
        return np.concatenate([self.block(number)._drawn(base, probe) for number in range(self.block_count)])

    def _drawn(self, base: FloatArray, probe: Probe) -> FloatArray:  # [P, 4, 4] -> [C, 4, 4] mm
        """The poses of one block from at least one checked base pose, by the generator of `seed`."""
        raise NotImplementedError


_BLOCKS = 0x626C6F63  # keeps the seeds of blocks apart from those of the rounds of a search


def seed_of(seed: int, *numbers: int) -> int:
    """The seed of a numbered part of what a seed stands for."""
    return int(np.random.SeedSequence([seed, *numbers]).generate_state(1, np.uint64)[0] >> np.uint64(1))


def count_field(*default: Any, high: int = MAX_POSES) -> Any:
    return described("How many poses.", *default, low=1, high=high)


def seed_field() -> Any:
    return described("Of the random choices.", 0, low=0, high=MAX_SEED)


@dataclass(frozen=True)
class AroundSampler(DrawnSampler):
    """`count` of the base poses, drawn at random with repetition, each turned and shifted at random.

    It turns about a random axis through the probe's origin by a normal angle of standard deviation `rotation_deg`, and
    shifts by a normal step of standard deviation `translation_mm` along each axis. Raises InvalidArgument.
    """

    count: int = count_field(high=MAX_DRAWN)
    translation_mm: float = described("Standard deviation along each axis.", 2.0, low=0.0, high=1000.0)
    rotation_deg: float = described("Standard deviation of the angle.", 5.0, low=0.0, high=180.0)
    seed: int = seed_field()
    kind: Literal["around"] = kind_field("around")

    def _drawn(self, base: FloatArray, probe: Probe) -> FloatArray:
        random = np.random.default_rng(self.seed)
        moved: FloatArray = base[random.integers(len(base), size=self.count)]
        axes = random_directions(random, self.count)
        angles = np.radians(random.normal(0.0, self.rotation_deg, self.count))
        moved[:, :3, :3] = moved[:, :3, :3] @ about_axes(axes, angles)
        moved[:, :3, 3] += random.normal(0.0, self.translation_mm, (self.count, 3))
        return moved


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
        corners = probe.corners_from(base)  # [P, K, 3] mm
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
        poses = np.tile(np.eye(4), (self.count, 1, 1))
        steps = second[:, :3, 3] - first[:, :3, 3]
        poses[:, :3, 3] = first[:, :3, 3] + shares[:, None] * steps
        poses[:, :3, :3] = blended(first[:, :3, :3], second[:, :3, :3], shares)
        radii = np.linalg.norm(steps, axis=1) * np.cbrt(random.uniform(size=self.count))
        poses[:, :3, 3] += radii[:, None] * random_directions(random, self.count)
        turns = turn_angles_rad(first[:, :3, :3], second[:, :3, :3]) * random.uniform(size=self.count)
        poses[:, :3, :3] = poses[:, :3, :3] @ about_axes(random_directions(random, self.count), turns)
        return poses


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


MAX_TILT_DEG = 90.0  # the beam lies along the skin then


@dataclass(frozen=True)
class FanSampler(Sampler):
    """The base poses, tilted by every multiple of `step_deg` from −`tilt_deg` to +`tilt_deg`: one sweep a tilt.

    The probe turns about its lateral axis x through the middle of its face, which stays where it is (linear: the
    origin; otherwise `near_mm` along the axial axis). A positive tilt turns the beam towards −y, as
    `freehand_poses(tilt_deg=…)` of the phantom does. Raises InvalidArgument.
    """

    tilt_deg: float = described("The largest tilt, to both sides.", low=0.0, high=MAX_TILT_DEG)
    step_deg: float = described("Between two tilts.", above=0.0, high=MAX_TILT_DEG)
    kind: Literal["fan"] = kind_field("fan")

    def _new_poses(self, base: FloatArray, probe: Probe) -> FloatArray:
        steps = math.floor(min(self.tilt_deg / self.step_deg, 1e9) + 1e-9)
        tilts = 2 * steps + 1
        self._require_few(float(tilts) * len(base), "step_deg")
        angles = np.radians(self.step_deg * np.arange(-steps, steps + 1))
        turns = about_axes(np.tile([1.0, 0.0, 0.0], (tilts, 1)), angles)
        fan = np.tile(base, (tilts, 1, 1, 1))  # [tilts, P, 4, 4]
        fan[..., :3, :3] = base[:, :3, :3] @ turns[:, None]
        axial = base[:, :3, 2] - fan[..., :3, 2]
        fan[..., :3, 3] += probe.pivot_depth_mm * axial
        return fan.reshape(-1, 4, 4)


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

    def _new_poses(self, base: FloatArray, probe: Probe) -> FloatArray:
        knots = _without_repetitions(base)
        if len(knots) < 2:
            raise InvalidArgument("sampler spline needs at least two different base poses, got one", field="kind")
        lengths = np.linalg.norm(np.diff(knots[:, :3, 3], axis=0), axis=1)
        at = np.concatenate([[0.0], np.cumsum(lengths)])
        places = self._places(float(at[-1]))
        segments = np.clip(np.searchsorted(at, places, side="right") - 1, 0, len(lengths) - 1)
        shares = (places - at[segments]) / lengths[segments]
        poses = np.tile(np.eye(4), (len(places), 1, 1))
        poses[:, :3, 3] = _natural_cubic(knots[:, :3, 3], lengths, segments, shares)
        poses[:, :3, :3] = blended(knots[segments, :3, :3], knots[segments + 1, :3, :3], shares)
        return poses

    def _places(self, length_mm: float) -> FloatArray:  # [C]
        if self.count is not None:
            return np.linspace(0.0, length_mm, self.count)
        assert self.spacing_mm is not None
        steps = min(length_mm / self.spacing_mm + 1e-9, 10.0 * MAX_POSES)
        self._require_few(math.floor(steps) + 1, "spacing_mm")
        distances: FloatArray = np.minimum(self.spacing_mm * np.arange(math.floor(steps) + 1), length_mm)
        return distances


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


@dataclass(frozen=True)
class TrainingSampler(Sampler):
    """The training poses of the scene as they are, in order."""

    kind: Literal["training"] = kind_field("training")

    def _new_poses(self, base: FloatArray, probe: Probe) -> FloatArray:
        return base
