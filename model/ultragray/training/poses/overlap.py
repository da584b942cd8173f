"""The registration of a sweep, as a whole, to others that cross it: by what they expect of its frames.

Each point of a frame is predicted by the nearest plane of another sweep on either side, by the distances to them; the
correlation of prediction and truth is climbed from large steps to small ones. Only detail counts, brightness over a
wider neighbourhood is taken off: shadows turn with the probe, and with them two sweeps that cross match best where they
are parallel (on the simulated liver by 6 mm and 6°).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ...datasets.sweep import Sweep
from ...display.scan_conversion import pixel_places
from ...probe import FloatArray
from .motion import about, motions_of

POINTS = 6_000
ROUNDS = 6  # of one size of step
_NUMBERS = 6  # of a motion: turns about x, y, z of the probe in degrees, shifts in mm
_WITHIN_THE_PLANE = (1, 3, 5)


class Level(NamedTuple):
    """One round of the climb."""

    pixels: tuple[float, float]  # standard deviations: of a blur, and of the neighbourhood that is taken off
    steps: tuple[float, ...]  # degrees and mm
    numbers: tuple[int, ...] = tuple(range(_NUMBERS))


LEVELS = (
    Level((4.0, 30.0), (4.0, 2.0, 1.0), _WITHIN_THE_PLANE),
    Level((2.0, 10.0), (2.0, 1.0, 0.5)),
    Level((0.0, 5.0), (1.0, 0.5, 0.25, 0.125)),
)
LARGEST_GAP = 3.0  # times the spacing of frames: farther planes say nothing
LEAST_POINTS = 0.1  # of all: sweeps with less in common are not compared
LEAST_GAIN = 0.05  # of the correlation, about that of 1 mm; the best match is off by some tenths of a mm itself


def register_sweeps(sweep: Sweep, ranges: Sequence[range]) -> FloatArray:  # [S, 4, 4]
    """The motion of each sweep, left-multiplied to its poses, that makes it agree with those before it.

    The identity for the first, and where sweeps have too little in common, or agree as they are.
    """
    details = [_detail(sweep, *level.pixels) for level in LEVELS]
    motions = np.tile(np.eye(4), (len(ranges), 1, 1))
    poses = sweep.poses.copy()
    for number in range(1, len(ranges)):
        match = _Match(sweep, details, np.concatenate([np.array(frames) for frames in ranges[:number]]), ranges[number])
        motion = match.climb(poses)
        if motion is not None:
            motions[number] = motion
            poses[ranges[number]] = motion @ poses[ranges[number]]
    return motions


class _Match:
    """One sweep against those that are placed already."""

    def __init__(self, sweep: Sweep, details: list[FloatArray], placed: FloatArray, moving: range) -> None:
        self._probe, self._details = sweep.probe, details
        self._placed, self._moving = placed, np.array(moving)
        rng = np.random.default_rng(0)
        self._ends = (rng.choice(self._moving, POINTS), rng.choice(placed, POINTS))
        self._rows, self._columns = rng.random((2, POINTS)), rng.random((2, POINTS))
        corners = sweep.corners_mm()
        self._centre = corners[self._moving].mean(axis=(0, 1))
        steps = [np.linalg.norm(np.diff(corners[part].mean(axis=1), axis=0), axis=1) for part in (self._moving, placed)]
        self._gap_mm = LARGEST_GAP * float(np.median(np.concatenate(steps)))

    def climb(self, poses: FloatArray) -> FloatArray | None:  # [F, 4, 4] -> [4, 4]
        """Hooke and Jeeves: one number after another, then on along what was gained. None without a clear gain."""
        axes = poses[self._moving[len(self._moving) // 2], :3, :3]
        here, last = np.zeros(_NUMBERS), len(LEVELS) - 1
        start = self._correlation(last, poses, here, axes)
        if not np.isfinite(start):
            return None  # the planes do not meet: any agreement found elsewhere would be chance
        best = -np.inf
        for place, level in enumerate(LEVELS):
            best = self._correlation(place, poses, here, axes)
            for step in level.steps:
                for _ in range(ROUNDS):
                    before, moved = here.copy(), False
                    for number in level.numbers:
                        for sign in (1.0, -1.0):
                            tried = here.copy()
                            tried[number] += sign * step
                            score = self._correlation(place, poses, tried, axes)
                            if score > best:
                                here, best, moved = tried, score, True
                                break
                    if not moved:
                        break
                    onwards = 2.0 * here - before
                    score = self._correlation(place, poses, onwards, axes)
                    if score > best:
                        here, best = onwards, score
        return self._motion(here, axes) if best - start >= LEAST_GAIN else None

    def _motion(self, numbers: FloatArray, axes: FloatArray) -> FloatArray:  # [6] degrees, mm -> [4, 4]
        twist = np.concatenate([np.radians(axes @ numbers[:3]), np.zeros(3)])
        motion: FloatArray = about(motions_of(torch.from_numpy(twist[None])).numpy(), self._centre[None])[0]
        motion[:3, 3] += axes @ numbers[3:]
        return motion

    def _correlation(self, level: int, poses: FloatArray, numbers: FloatArray, axes: FloatArray) -> float:
        moved = poses.copy()
        moved[self._moving] = self._motion(numbers, axes) @ poses[self._moving]
        others = (self._placed, self._moving)
        truth, predicted = zip(*(self._predicted(level, moved, end, others[end]) for end in (0, 1)), strict=True)
        x, y = np.concatenate(truth), np.concatenate(predicted)
        if len(x) < LEAST_POINTS * 2 * POINTS:
            return -np.inf
        return float(np.corrcoef(x, y)[0, 1])

    def _predicted(self, level: int, poses: FloatArray, end: int, others: FloatArray) -> tuple[FloatArray, FloatArray]:
        frames, rows, columns = self._ends[end], self._rows[end], self._columns[end]
        local = self._probe.points_mm(rows, columns)
        points = np.einsum("pij,pj->pi", poses[frames, :3, :3], local) + poses[frames, :3, 3]
        normals, origins = poses[others, :3, 1], poses[others, :3, 3]
        heights = points @ normals.T - np.einsum("fi,fi->f", normals, origins)  # [P, F]
        known = np.ones(len(points), bool)
        values, weights = [], []
        for side in (1.0, -1.0):
            distances = np.where(side * heights >= 0.0, side * heights, np.inf)
            nearest = distances.argmin(axis=1)
            distance = distances[np.arange(len(points)), nearest]
            plane = others[nearest]
            seen = np.einsum("pi,pij->pj", points - poses[plane, :3, 3], poses[plane, :3, :3])
            r, c = self._probe.image_coordinates(seen[:, 0], seen[:, 2])
            inside = ~np.isnan(r) & (distance < self._gap_mm)
            known &= inside
            values.append(self._sampled(level, plane, np.where(inside, r, 0.0), np.where(inside, c, 0.0)))
            weights.append(1.0 / np.maximum(np.where(inside, distance, 1.0), 1e-6))
        blended = (weights[0] * values[0] + weights[1] * values[1]) / (weights[0] + weights[1])
        return self._sampled(level, frames, rows, columns)[known], blended[known]

    def _sampled(
        self, level: int, frames: FloatArray, rows: FloatArray, columns: FloatArray
    ) -> FloatArray:  # [P] each -> [P]
        image = self._details[level]
        _, height, width = image.shape
        i, j = pixel_places(self._probe, (height, width), rows, columns)
        top, left = np.floor(i).astype(np.intp), np.floor(j).astype(np.intp)
        down, right = i - top, j - left
        below, beside = np.minimum(top + 1, height - 1), (left + 1) % width
        upper = image[frames, top, left] * (1 - right) + image[frames, top, beside] * right
        lower = image[frames, below, left] * (1 - right) + image[frames, below, beside] * right
        sampled: FloatArray = upper * (1 - down) + lower * down
        return sampled


def _detail(sweep: Sweep, blur: float, around: float) -> FloatArray:  # [F, H, W]
    """Structure wider than one standard deviation and narrower than the other, in pixels."""
    found = []
    for image in torch.split(torch.from_numpy(sweep.images), 32):
        grey = image.float() / 255.0
        found.append(_blurred(grey, blur) - _blurred(grey, around))
    made: FloatArray = torch.cat(found).numpy()
    return made


def _blurred(images: Tensor, sigma: float) -> Tensor:  # [F, H, W] -> [F, H, W]
    if sigma == 0.0:
        return images
    radius = int(3 * sigma)
    offsets = torch.arange(-radius, radius + 1, dtype=torch.float32)
    kernel = torch.softmax(-0.5 * (offsets / sigma).square(), dim=0)
    padded = functional.pad(images[:, None], (radius,) * 4, mode="replicate")
    return functional.conv2d(functional.conv2d(padded, kernel[None, None, :, None]), kernel[None, None, None])[:, 0]
