"""Passes that cross are brought to agree along their whole length. Read after `alignment`; `agreement` calls it.

A tracker wanders: its error changes over a second or more. Within one pass that shows nowhere; where two passes cross,
each shows the anatomy of the other beside its place. So do tissue that one of them pressed, and what a delay or the
noise that was taken off has left. Each pass is moved by a smooth motion along its path, and Gauss–Newton finds the
motions with which the passes predict each other best.

The motion of frame f is a twist ξ_f = (ω, t), mm: a turn by ω / lever about the middle of the image, and the shift t,
both along the axes of the probe; over the frames of a pass, ξ = B·c with cubic B-splines B, a knot every KNOT_FRAMES
training frames. A point x of frame f is moved by D_f(x)·ξ_f. The planes i = 1, 2 of another pass on either side of x
predict what f shows there, linearly between them: q(x) = w₁·v₁ + w₂·v₂. These planes move, too, so that to first order

    shown − (a·q + b) = a·∇q(x) · (D_f·ξ_f − w₁·D₁·ξ₁ − w₂·D₂·ξ₂),

which is linear in c. The least squares are weighted against outliers as Huber has it, since shadows and speckle differ
between the passes, and c is taken to be normally distributed about 0 with the deviation USUAL_MM: what the images do
not tell stays as tracked. Twelve thousand points for some hundred numbers could hardly be fitted by chance; whether
the motions are true is nevertheless asked of as many other points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import rotations_of, transforms_of
from ultragray.geometry.scan_conversion import interpolated_frames, pixel_places
from ultragray.learn.sweep import IntArray, Sweep, spread_places
from ultragray.learn.training.alignment import LARGEST_GAP, LEAST_POINTS, detail, nearest_planes

Frames: TypeAlias = npt.NDArray[Any]  # [F, H, W]

POINTS = 12_000  # that the motions follow from, and as many that they are judged by
FRAMES = 600  # that are looked at, evenly spread: bounds time and memory for long sweeps
KNOT_FRAMES = 4  # training frames from one knot of a motion to the next: some tenths of a second
MOST_KNOTS = 64  # of all passes together
USUAL_MM = 0.2  # standard deviation of a coefficient
LEVELS = ((4.0, 30.0), (2.0, 10.0), (0.7, 5.0))  # pixels: deviations of a blur, and of the neighbourhood taken off
STEPS = 8  # of each at most
SMALL_MM = 0.02  # after a step that changes no coefficient by more, a level is over
LEAST_GAIN = 0.01  # of the correlation: where poses are exact, it gains half of that at most
OUTLIER = 2.0  # standard deviations: beyond, a residual counts in proportion, no longer by its square
_NUMBERS = 6  # of a twist
_ROWS = 4096  # of the least squares at a time


@dataclass(frozen=True, eq=False)
class Agreement:
    """The motions with which passes agree where they cross, and how far they do."""

    motions: FloatArray  # [F, 4, 4] mm, right-multiplied to the poses
    shift_mm: float  # of the middles of the images by them, root mean square
    before: float  # correlation of what one pass shows and another predicts, as they were
    after: float  # the same with the motions


def crossing_agreement(
    sweep: Sweep,  # N training frames
    path: FloatArray,  # [F, 4, 4] mm: the poses of all frames, in their order
    ranges: Sequence[range],  # the passes: places on the path
    places: IntArray,  # [N] of the training frames
) -> Agreement | None:
    """The motions of all frames of a path with which its passes agree; of a held-out one, that of the frames about it.

    None where the training frames are of one pass, where passes have little in common, and where they do not agree
    better by LEAST_GAIN.
    """
    some = spread_places(len(sweep), FRAMES)
    chosen = places[some]
    passes = np.repeat(np.arange(len(ranges)), [len(frames) for frames in ranges])[chosen]
    if len(np.unique(passes)) < 2:
        return None
    looked_at = replace(sweep.select(some), poses=path[chosen])
    fitted, judged = (_Crossing(looked_at, passes, seed) for seed in range(2))
    all_splines = _splines(ranges, max(KNOT_FRAMES * len(path) / len(sweep), len(path) / MOST_KNOTS))
    splines = all_splines[chosen]
    still = np.zeros((splines.shape[1], _NUMBERS))
    if len(judged.seen(looked_at.images, looked_at.poses).values) < LEAST_POINTS * POINTS:
        return None
    coefficients = still
    for level in LEVELS:
        details = detail(looked_at, *level)
        for _ in range(STEPS):
            earlier = coefficients
            coefficients = fitted.improved(details, max(1.0, level[0]), splines, earlier)
            if np.abs(coefficients - earlier).max() < SMALL_MM:
                break
    before, after = (judged.correlation(details, splines @ one) for one in (still, coefficients))
    if not after >= before + LEAST_GAIN:
        return None
    twists = all_splines @ coefficients
    shift_mm = float(np.sqrt(np.square(twists[:, 3:]).sum(axis=1).mean()))
    return Agreement(fitted.motions(twists), shift_mm, before, after)


def _splines(ranges: Sequence[range], spacing: float) -> FloatArray:  # [F, K]
    """Uniform cubic B-splines along each pass, a knot about every `spacing` frames."""
    blocks = []
    for frames in ranges:
        intervals = max(1, round((len(frames) - 1) / spacing))
        knots = np.arange(-1, intervals + 2)
        away = np.abs(np.linspace(0.0, intervals, len(frames))[:, None] - knots)
        blocks.append(np.where(away < 1.0, 2 / 3 - away**2 + away**3 / 2, np.maximum(2.0 - away, 0.0) ** 3 / 6))
    splines = np.zeros((sum(map(len, blocks)), sum(block.shape[1] for block in blocks)))
    row = column = 0
    for block in blocks:
        rows, columns = block.shape
        splines[row : row + rows, column : column + columns] = block
        row, column = row + rows, column + columns
    return splines


@dataclass(frozen=True, eq=False)
class _Seen:
    """Points that a frame shows and two planes of another pass predict."""

    points: FloatArray  # [Q, 3] mm
    frames: IntArray  # [3, Q] places: of the frame, and of the planes
    shares: FloatArray  # [3, Q] of their motions in that of the point past the planes: 1, −w₁, −w₂
    values: FloatArray  # [Q]
    predicted: FloatArray  # [Q]


class _Crossing:
    """Points drawn in the frames of a sweep, and how the planes of its other passes predict what is shown there."""

    def __init__(self, sweep: Sweep, passes: IntArray, seed: int) -> None:
        self._sweep, self._passes = sweep, passes
        random = np.random.default_rng(seed)
        self._frames = random.choice(len(sweep), POINTS)
        self._rows, self._columns = random.random((2, POINTS))
        self._local = sweep.probe.points_mm(self._rows, self._columns)
        corners = sweep.probe.corners_mm()
        self._middle = corners.mean(axis=0)
        self._lever_mm = float(np.linalg.norm(corners - self._middle, axis=1).mean())
        steps = np.linalg.norm(np.diff(sweep.corners_mm().mean(axis=1), axis=0), axis=1)
        self._gap_mm = LARGEST_GAP * float(np.median(steps))

    def motions(self, twists: FloatArray) -> FloatArray:  # [F, 6] mm -> [F, 4, 4] mm
        turns = rotations_of(twists[:, :3] / self._lever_mm)
        return transforms_of(turns, self._middle - turns @ self._middle + twists[:, 3:])

    def correlation(self, details: Frames, twists: FloatArray) -> float:
        """Of what is shown and what is predicted, the frames moved by the twists [F, 6]."""
        seen = self.seen(details, self._sweep.poses @ self.motions(twists))
        return float(np.corrcoef(seen.values, seen.predicted)[0, 1])

    def improved(
        self, details: Frames, step_pixels: float, splines: FloatArray, coefficients: FloatArray
    ) -> FloatArray:  # [F, H, W], [F, K], [K, 6] -> [K, 6]
        """The coefficients after a step of Gauss–Newton; slopes are differences over `step_pixels` to either side."""
        poses = self._sweep.poses @ self.motions(splines @ coefficients)
        seen = self.seen(details, poses)
        if len(seen.values) < LEAST_POINTS * POINTS:
            return coefficients  # the passes have been moved apart
        slopes, known = self._slopes(details, poses, seen, step_pixels * min(self._sweep.pixel_mm))
        scale, offset = np.polyfit(seen.predicted, seen.values, 1)
        residuals = seen.values - scale * seen.predicted - offset
        deviation = max(float(residuals.std()), 1e-6)
        weights = known / np.maximum(1.0, np.abs(residuals) / (OUTLIER * deviation)) / deviation**2
        size = coefficients.size
        normal, right = np.eye(size) / USUAL_MM**2, -coefficients.reshape(-1) / USUAL_MM**2
        for first in range(0, len(residuals), _ROWS):
            some = slice(first, first + _ROWS)
            along = np.empty((len(residuals[some]), 3, 6))
            for place, (frames, shares) in enumerate(zip(seen.frames[:, some], seen.shares[:, some], strict=True)):
                moved = self._moved(poses[frames], seen.points[some])  # [Q, 3, 6]
                along[:, place] = scale * shares[:, None] * np.einsum("qi,qij->qj", slopes[some], moved)
            flat = (splines[seen.frames[:, some]].transpose(1, 2, 0) @ along).reshape(-1, size)
            weighted = flat.T * weights[some]
            normal += weighted @ flat
            right += weighted @ residuals[some]
        step = np.asarray(np.linalg.solve(normal, right), np.float64)
        return coefficients + step.reshape(coefficients.shape)

    def seen(self, details: Frames, poses: FloatArray) -> _Seen:
        """The points that lie between two planes of another pass, near both: once for each pass of which that is so."""
        own = poses[self._frames]
        points: FloatArray = np.einsum("pij,pj->pi", own[:, :3, :3], self._local) + own[:, :3, 3]
        parts = []
        for mine, other in permutations(np.unique(self._passes), 2):
            here, there = np.flatnonzero(self._passes[self._frames] == mine), np.flatnonzero(self._passes == other)
            nearest, distances = nearest_planes(points[here], poses[there])
            near = (distances < self._gap_mm).all(axis=0)
            parts.append((here[near], there[nearest[:, near]]))
        chosen, planes = (np.concatenate(some, axis=-1) for some in zip(*parts, strict=True))
        predicted, shares = self._predicted(details, poses, points[chosen], planes)
        inside = ~np.isnan(predicted)
        chosen, planes = chosen[inside], planes[:, inside]
        frames = self._frames[chosen]
        return _Seen(
            points[chosen],
            np.concatenate([frames[None], planes]),
            np.concatenate([np.ones((1, len(frames))), -shares[:, inside]]),
            self._sampled(details, frames, self._rows[chosen], self._columns[chosen]),
            predicted[inside],
        )

    def _predicted(
        self, details: Frames, poses: FloatArray, points: FloatArray, planes: IntArray
    ) -> tuple[FloatArray, FloatArray]:  # [Q, 3], [2, Q] -> [Q], [2, Q]
        """What the planes on either side of each point predict, NaN beside an image; and the shares of the two."""
        local = np.einsum("sqi,sqij->sqj", points - poses[planes, :3, 3], poses[planes, :3, :3])
        rows, columns = self._sweep.probe.image_coordinates(local[..., 0], local[..., 2])
        inside = ~np.isnan(rows).any(axis=0)
        values = self._sampled(details, planes, np.nan_to_num(rows), np.nan_to_num(columns))
        above, below = local[0, :, 1], -local[1, :, 1]
        shares = np.clip(np.stack([below, above]) / np.maximum(above + below, 1e-6), -0.5, 1.5)  # planes may meet there
        return np.where(inside, (shares * values).sum(axis=0), np.nan), shares

    def _slopes(
        self, details: Frames, poses: FloatArray, seen: _Seen, step_mm: float
    ) -> tuple[FloatArray, FloatArray]:  # [Q, 3], [Q]
        """Of the prediction along x, y, z of the tracker, per mm; and 1 where they are known, else 0."""
        slopes = np.stack(
            [
                self._predicted(details, poses, seen.points + step, seen.frames[1:])[0]
                - self._predicted(details, poses, seen.points - step, seen.frames[1:])[0]
                for step in step_mm * np.eye(3)
            ],
            axis=1,
        )
        known = np.asarray(np.isfinite(slopes).all(axis=1), np.float64)
        return np.nan_to_num(slopes) / (2.0 * step_mm), known

    def _moved(self, poses: FloatArray, points: FloatArray) -> FloatArray:  # [Q, 4, 4], [Q, 3] -> [Q, 3, 6]
        """How points move with the twists of frames: D of the equation."""
        local = np.einsum("qi,qij->qj", points - poses[:, :3, 3], poses[:, :3, :3]) - self._middle
        turned = np.cross(np.eye(3), local[:, None]) / self._lever_mm  # [Q, 3, 3]: of each axis of the turn
        with_twist = np.concatenate([turned.transpose(0, 2, 1), np.tile(np.eye(3), (len(points), 1, 1))], axis=2)
        moved: FloatArray = poses[:, :3, :3] @ with_twist
        return moved

    def _sampled(self, details: Frames, frames: IntArray, rows: FloatArray, columns: FloatArray) -> FloatArray:
        return interpolated_frames(details, frames, *pixel_places(self._sweep.probe, details.shape[1:], rows, columns))
