"""Poses put right before a training, from the tracked path and the images alone. Read after `poses`, which calls it.

First the likelihood of second differences, then the tracker's noise and the path without it, then the registration of
whole sweeps where they overlap.

D takes the second differences of a path of F poses: D·p is [F−2], D·Dᵀ has the rows 1 −4 6 −4 1. With noise of variance
r on the poses and accelerations of variance q, the second differences that one sees have the covariance
r·(ρ·1 + D·Dᵀ), ρ = q/r. It has five diagonals; in its factors L·diag(d)·Lᵀ the lower triangle L has ones on the
diagonal and two diagonals below it, and each row follows from the two rows before it. So a likelihood, or the smoothed
path, takes time and memory that grow linearly with the length of the path.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import mean_axes, rotations_of, transforms_of, turns_of
from ultragray.geometry.scan_conversion import FloatImage, interpolated_frames, pixel_places
from ultragray.learn.sweep import IntArray, Sweep, corner_distances_mm, spread_places, usual_step


def likelihood_terms(bends: FloatArray, ratios: FloatArray) -> tuple[FloatArray, FloatArray]:
    """log det(ρ·1 + D·Dᵀ) [R] and bᵀ(ρ·1 + D·Dᵀ)⁻¹b [R, K] for each ratio ρ [R] and each column b of `bends` [B, K]."""
    log_determinants = np.zeros(len(ratios))
    squares = np.zeros((len(ratios), bends.shape[1]))
    one_back, two_back = np.zeros_like(squares), np.zeros_like(squares)  # rows of L⁻¹b
    for bend, (first, second, diagonal) in zip(bends, _factor_rows(len(bends), ratios), strict=True):
        solved = bend - first[:, None] * one_back - second[:, None] * two_back
        log_determinants += np.log(diagonal)
        squares += solved * solved / diagonal[:, None]
        one_back, two_back = solved, one_back
    return log_determinants, squares


def smoothed(values: FloatArray, ratio: float) -> FloatArray:  # [F] -> [F]
    """The path p of least ρ·|values − p|² + |D·p|², which is values − Dᵀ(ρ·1 + D·Dᵀ)⁻¹D·values. F is at least 4."""
    solution = np.diff(values, 2)
    first, second, diagonal = np.array([*_factor_rows(len(solution), np.array([ratio]))])[..., 0].T
    for row in range(len(solution)):  # negative places are multiplied by the zeros of the first two rows
        solution[row] -= first[row] * solution[row - 1] + second[row] * solution[row - 2]
    solution /= diagonal
    for row in reversed(range(len(solution))):
        solution[row - 1] -= first[row] * solution[row]
        solution[row - 2] -= second[row] * solution[row]
    return values - np.convolve(solution, [1.0, -2.0, 1.0])


def _factor_rows(count: int, ratios: FloatArray) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """Row by row, for each ratio [R]: the entries of L one and two columns left of the diagonal, and that of d."""
    first = np.zeros_like(ratios)
    one_back = two_back = np.full_like(ratios, np.inf)  # d of the rows before
    for _ in range(count):
        rest = -4.0 - first
        first, second = rest / one_back, 1.0 / two_back
        diagonal = 6.0 + ratios - first * rest - second
        yield first, second, diagonal
        one_back, two_back = diagonal, one_back


# Estimates from the tracked path alone: where a new sweep begins, the tracker's noise, and the path without it.
#
# A hand or a robot moves a probe smoothly, while a tracker's errors differ from frame to frame. A pose has six
# coordinates: the position of the probe's origin along the sweep's mean axes, and its turns about its own axes, added
# up from frame to frame: a probe may turn as far as it likes. The second differences of each are the sum of two
# independent parts: those of the path, with variance q, and those of the tracker's error, D·e with variance r of e. The
# two parts have different spectra, so q and r are found by maximum likelihood; the path is then the posterior mean. A
# tracker's errors have the same size along all three axes, but a probe that moves unevenly along its path looks noisy
# in that direction: the smallest r of the three is taken for all.

JUMP = 6.0  # usual steps: a longer step begins a new sweep
LEAST_FRAMES = 5  # of a sweep: fewer are not a path
RATIOS = 10.0 ** np.arange(-6.0, 6.01, 0.25)  # of the variances q/r that are tried
TINY = 1e-300  # a variance whose logarithm is finite
_NUMBERS = 6


@dataclass(frozen=True)
class TrackerNoise:
    """Standard deviations of a tracker's errors from frame to frame: along and about each axis, the least of three, and
    what each axis of the probe seems to have by itself."""

    position_mm: float
    turn_deg: float
    axes_mm: tuple[float, float, float]  # lateral, elevation (with what the hand goes unevenly), axial


def sweep_ranges(sweep: Sweep) -> list[range]:
    """The places of the frames of each sweep, in order: a new one begins where the path jumps."""
    return path_ranges(sweep.corners_mm())


def path_ranges(corners: FloatArray) -> list[range]:  # [F, K, 3] mm
    """The same of a path, by the corners of its images."""
    steps = corner_distances_mm(corners[1:], corners[:-1])
    starts = [0]
    for place in np.flatnonzero(steps > JUMP * usual_step(steps)) + 1:
        if place - starts[-1] >= LEAST_FRAMES and len(corners) - place >= LEAST_FRAMES:
            starts.append(int(place))
    return [range(first, last) for first, last in pairwise([*starts, len(corners)])]


def tracker_noise(poses: FloatArray, ranges: Sequence[range]) -> TrackerNoise:  # [F, 4, 4] mm
    """The tracker's errors, estimated from the path alone; 0 where the path is too short for an estimate."""
    likelihood = _Likelihood.of(_coordinates(poses, ranges), ranges)
    (position, turn), axes = likelihood.noise_variances(), np.sqrt(likelihood.variances_by_axis()[:3]).tolist()
    return TrackerNoise(float(np.sqrt(position)), float(np.sqrt(turn)), (axes[0], axes[1], axes[2]))


def without_noise(poses: FloatArray, ranges: Sequence[range]) -> FloatArray:  # [F, 4, 4] mm -> [F, 4, 4] mm
    coordinates = _coordinates(poses, ranges)
    likelihood = _Likelihood.of(coordinates, ranges)
    noise = np.repeat(likelihood.noise_variances(), 3)
    cleaned = coordinates.copy()
    for number in range(_NUMBERS):
        if noise[number] == 0.0:
            continue
        costs = likelihood.log_determinants + likelihood.squares[:, number] / noise[number]
        ratio = float(RATIOS[costs.argmin()])  # the likeliest q/r where r is the noise
        for frames in _long_enough(ranges):
            cleaned[frames, number] = smoothed(coordinates[frames, number], ratio)
    clean_poses = poses.copy()
    for frames in ranges:
        clean_poses[frames, :3, 3] = cleaned[frames, :3] @ mean_axes(poses[frames]).T
    clean_poses[:, :3, :3] @= rotations_of(np.radians(cleaned[:, 3:] - coordinates[:, 3:]))
    return clean_poses


def _coordinates(poses: FloatArray, ranges: Sequence[range]) -> FloatArray:  # [F, 6] mm, degrees
    coordinates = np.zeros((len(poses), _NUMBERS))
    for frames in ranges:
        own = poses[frames]
        turns = turns_of(own[:-1, :3, :3].transpose(0, 2, 1) @ own[1:, :3, :3])
        coordinates[frames, :3] = own[:, :3, 3] @ mean_axes(own)
        coordinates[frames[1:], 3:] = np.degrees(turns.cumsum(axis=0))
    return coordinates


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
        best = self.variances_by_axis()
        return float(best[:3].min()), float(best[3:].min())

    def variances_by_axis(self) -> FloatArray:  # [6] mm², degrees²
        variances = self.squares / max(self.count, 1)
        costs = self.count * np.log(np.maximum(variances, TINY)) + self.log_determinants[:, None]
        best: FloatArray = variances[costs.argmin(axis=0), np.arange(_NUMBERS)]
        return best


# The registration of whole sweeps that cross: each is moved until its frames agree with those of the sweeps before
# it.
#
# Each point of a frame is predicted from the two nearest planes of the other side, one on either side of the point,
# weighted by their inverse distances. The motion that maximises the correlation of predicted and true values is
# searched with large steps first, then with small ones. The mean brightness of a wider neighbourhood is subtracted
# before: shadows turn with the probe, and with them two sweeps that cross correlate best where they are parallel (6
# mm and 6° off on the simulated liver).

HalfArray: TypeAlias = npt.NDArray[np.float16]

POINTS = 6_000
ROUNDS = 6  # of one size of step
_OVERLAP_NUMBERS = 6  # of a motion: turns about x, y, z of the probe in degrees, shifts in mm
_UNITS = np.eye(_OVERLAP_NUMBERS)
_WITHIN_THE_PLANE = (1, 3, 5)


class Level(NamedTuple):
    """One round of the climb."""

    pixels: tuple[float, float]  # standard deviations: of a blur, and of the neighbourhood that is taken off
    steps: tuple[float, ...]  # degrees and mm
    numbers: tuple[int, ...] = tuple(range(_OVERLAP_NUMBERS))


LEVELS = (
    Level((4.0, 30.0), (4.0, 2.0, 1.0), _WITHIN_THE_PLANE),
    Level((2.0, 10.0), (2.0, 1.0, 0.5)),
    Level((0.0, 5.0), (1.0, 0.5, 0.25, 0.125)),
)
FRAMES = 300  # of either side that are compared, evenly spread: bounds time and memory for long sweeps
LARGEST_GAP = 3.0  # times the spacing of frames: farther planes predict nothing
LEAST_POINTS = 0.1  # of all: sweeps with less in common are not compared
LEAST_GAIN = 0.05  # of the correlation, about that of 1 mm; the best match is off by some tenths of a mm itself


def register_sweeps(sweep: Sweep, ranges: Sequence[range]) -> FloatArray:  # [S, 4, 4]
    """The motion of each sweep, left-multiplied to its poses, that makes it agree with those before it.

    The identity for the first, and where sweeps have too little in common, or agree as they are.
    """
    motions = np.tile(np.eye(4), (len(ranges), 1, 1))
    poses = sweep.poses.copy()
    for number in range(1, len(ranges)):
        placed, moving = np.concatenate(ranges[:number]), np.array(ranges[number])
        motion = _Match(_portion(sweep, poses, moving), _portion(sweep, poses, placed)).climb()
        if motion is not None:
            motions[number] = motion
            poses[moving] = motion @ poses[moving]
    return motions


def _portion(sweep: Sweep, poses: FloatArray, places: IntArray) -> Sweep:
    """At most FRAMES of the frames at these places, with these poses [F, 4, 4] of the whole sweep."""
    chosen = places[spread_places(len(places), FRAMES)]
    return replace(sweep.select(chosen), poses=poses[chosen])


class _Crossing(NamedTuple):
    """Points of one side that lie between two planes of the other, near enough to be predicted by both."""

    points: IntArray  # [P] places of the points among those that were drawn
    planes: IntArray  # [2, P] places of the nearest frames on either side of each point
    distances_mm: FloatArray  # [2, P]
    rows: FloatArray  # [2, P] image coordinates of each point in the planes
    columns: FloatArray  # [2, P]


class _Match:
    """The search for the motion of one side, `moving`, that makes it agree with the other, which stays."""

    _least_correlation = -1.0

    def __init__(self, moving: Sweep, placed: Sweep) -> None:
        self._probe, self._sweeps = moving.probe, (moving, placed)
        rng = np.random.default_rng(0)
        self._frames = [rng.choice(len(sweep), POINTS) for sweep in self._sweeps]
        self._rows, self._columns = rng.random((2, POINTS)), rng.random((2, POINTS))
        middles = [sweep.corners_mm().mean(axis=1) for sweep in self._sweeps]
        self._centre = middles[0].mean(axis=0)
        self._axes = moving.poses[len(moving) // 2, :3, :3]
        steps = [np.linalg.norm(np.diff(middle, axis=0), axis=1) for middle in middles]
        self._gap_mm = LARGEST_GAP * float(np.median(np.concatenate(steps)))

    def climb(self, levels: Sequence[Level] = LEVELS) -> FloatArray | None:  # [4, 4]
        """The motion of the best correlation; None where the sides do not meet as they are, or little is gained."""
        here, reached, gain = np.zeros(_OVERLAP_NUMBERS), 0.0, 0.0
        if not _has_enough(self._crossings(here)):
            return None  # any agreement found elsewhere would be chance
        for level in levels:
            correlation = partial(self._correlation, [detail(sweep, *level.pixels) for sweep in self._sweeps])
            here = _climbed(correlation, here, level)
            reached = correlation(here)
            gain = reached - correlation(np.zeros(_OVERLAP_NUMBERS))
        return self._motion(here) if gain >= LEAST_GAIN and reached >= self._least_correlation else None

    def _motion(self, numbers: FloatArray) -> FloatArray:  # [6] degrees, mm -> [4, 4]
        turn = rotations_of(np.radians(self._axes @ numbers[:3])[None])[0]
        return transforms_of(turn, self._centre - turn @ self._centre + self._axes @ numbers[3:])

    def _correlation(self, details: Sequence[HalfArray], numbers: FloatArray) -> float:
        """Of the true and the predicted details of both sides; −∞ where they have too little in common."""
        crossings = self._crossings(numbers)
        if not _has_enough(crossings):
            return -np.inf
        truth, predicted = [], []
        for side, crossing in enumerate(crossings):
            frames = self._frames[side][crossing.points]
            rows, columns = self._rows[side][crossing.points], self._columns[side][crossing.points]
            truth.append(self._sampled(details[side], frames, rows, columns))
            values = self._sampled(details[1 - side], crossing.planes, crossing.rows, crossing.columns)
            weights = 1.0 / np.maximum(crossing.distances_mm, 1e-6)
            predicted.append((weights * values).sum(axis=0) / weights.sum(axis=0))
        return float(np.corrcoef(np.concatenate(truth), np.concatenate(predicted))[0, 1])

    def _crossings(self, numbers: FloatArray) -> list[_Crossing]:
        """Of the points of either side, the moving one having been moved."""
        moving, placed = (sweep.poses for sweep in self._sweeps)
        poses = (self._motion(numbers) @ moving, placed)
        return [self._crossing(side, poses[side], poses[1 - side]) for side in range(2)]

    def _crossing(self, side: int, poses: FloatArray, others: FloatArray) -> _Crossing:
        local, own = self._probe.points_mm(self._rows[side], self._columns[side]), poses[self._frames[side]]
        points = np.einsum("pij,pj->pi", own[:, :3, :3], local) + own[:, :3, 3]
        planes, distances = nearest_planes(points, others)
        seen = np.einsum("spi,spij->spj", points - others[planes, :3, 3], others[planes, :3, :3])
        rows, columns = self._probe.image_coordinates(seen[..., 0], seen[..., 2])
        known = np.flatnonzero((~np.isnan(rows) & (distances < self._gap_mm)).all(axis=0))
        return _Crossing(known, planes[:, known], distances[:, known], rows[:, known], columns[:, known])

    def _sampled(self, details: HalfArray, frames: IntArray, rows: FloatArray, columns: FloatArray) -> FloatArray:
        return interpolated_frames(details, frames, *pixel_places(self._probe, details.shape[1:], rows, columns))


# The calibration from the image to the probe, where sweeps cross: with a wrong one, an image lies beside its place in
# another direction after the probe was turned. It is searched as the motion of whole sweeps is, but moves both sides in
# the frames of their probes. What the turns between the sweeps do not tell (along the axis that they turn about) stays
# small by a prior.

CALIBRATION_LEVELS = (Level((2.0, 10.0), (1.0, 0.5)), Level((0.0, 5.0), (0.5, 0.25, 0.125)))
CALIBRATION_PRIOR = 1e-3  # of the correlation, for each mm² and degree²
LEAST_CORRELATION = 0.5  # with the right one; less is left over where something else is wrong
LEAST_CROSSING_DEG = 20.0  # sweeps that are turned less against each other hardly tell


def found_calibration(sweep: Sweep, ranges: Sequence[range]) -> FloatArray:  # [4, 4]
    """The motion in the frame of the probe, right-multiplied to all poses, with which crossing sweeps agree best.

    The identity where none crosses the first, or none agrees clearly better than as calibrated.
    """
    means = np.stack([mean_axes(sweep.poses[frames]) for frames in ranges])
    turns_deg = np.degrees(np.linalg.norm(turns_of(means[0].T @ means), axis=1))
    crossing = [frames for frames, turn_deg in zip(ranges, turns_deg, strict=True) if turn_deg >= LEAST_CROSSING_DEG]
    if not crossing:
        return np.eye(4)
    sides = (_portion(sweep, sweep.poses, np.concatenate(part)) for part in (crossing, ranges[:1]))
    calibration = _CalibrationMatch(*sides).climb(CALIBRATION_LEVELS)
    return np.eye(4) if calibration is None else calibration


class _CalibrationMatch(_Match):
    """The search for the motion of the images in the frame of their probe that makes two sides agree."""

    _least_correlation = LEAST_CORRELATION

    def _motion(self, numbers: FloatArray) -> FloatArray:  # [6] degrees, mm -> [4, 4]
        """About the middle of the image, and along its axes."""
        motion, middle = np.eye(4), self._probe.corners_mm().mean(axis=0)
        motion[:3, :3] = rotations_of(np.radians(numbers[:3])[None])[0]
        motion[:3, 3] = middle - motion[:3, :3] @ middle + numbers[3:]
        return motion

    def _crossings(self, numbers: FloatArray) -> list[_Crossing]:
        motion = self._motion(numbers)
        poses = [sweep.poses @ motion for sweep in self._sweeps]
        return [self._crossing(side, poses[side], poses[1 - side]) for side in range(2)]

    def _correlation(self, details: Sequence[HalfArray], numbers: FloatArray) -> float:
        return super()._correlation(details, numbers) - CALIBRATION_PRIOR * float(np.square(numbers).sum())


def _has_enough(crossings: Sequence[_Crossing]) -> bool:
    return sum(len(crossing.points) for crossing in crossings) >= LEAST_POINTS * 2 * POINTS


def nearest_planes(points: FloatArray, poses: FloatArray) -> tuple[IntArray, FloatArray]:  # [P, 3], [F, 4, 4]
    """The nearest of the image planes on either side of each point, and its distance, mm: [2, P] both.

    The distance is infinite where there is no plane on that side.
    """
    normals, origins = poses[:, :3, 1], poses[:, :3, 3]
    heights = points @ normals.T - np.einsum("fi,fi->f", normals, origins)  # [P, F]
    sides = [np.where(height >= 0.0, height, np.inf) for height in (heights, -heights)]
    planes = np.stack([side.argmin(axis=1) for side in sides])
    return planes, np.stack([side[np.arange(len(points)), at] for side, at in zip(sides, planes, strict=True)])


def _climbed(score: Callable[[FloatArray], float], start: FloatArray, level: Level) -> FloatArray:  # [6] -> [6]
    """Hooke and Jeeves: each number is moved a step up or down, then all of them again by what was gained."""
    here, best = start, score(start)
    for step in level.steps:
        for _ in range(ROUNDS):
            before = here
            for number in level.numbers:
                for moved in (here + step * _UNITS[number], here - step * _UNITS[number]):
                    if (gained := score(moved)) > best:
                        here, best = moved, gained
                        break
            if here is before:
                break
            onwards = 2.0 * here - before
            if (gained := score(onwards)) > best:
                here, best = onwards, gained
    return here


def detail(sweep: Sweep, blur: float, around: float) -> HalfArray:  # [F, H, W]
    """Structure wider than one standard deviation and narrower than the other, in pixels."""
    details = np.empty(sweep.images.shape, np.float16)
    for image, target in zip(sweep.images, details, strict=True):
        grey = image / np.float32(255.0)
        target[:] = _blurred(grey, blur) - _blurred(grey, around)
    return details


def _blurred(image: FloatImage, sigma: float) -> FloatImage:  # [H, W] -> [H, W]
    if sigma == 0.0:
        return image
    return cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE).astype(np.float32, copy=False)
