"""Views between the frames of a sweep, and beyond its ends: what the frames on either side say that a plane shows.

Frames show only the edges of the gap between them, and a training could put anything inside. So it also sees planes
between neighbouring frames (`neighbours_of`), at a place drawn anew each time, with the two frames blended by their
distances, in the way that predicts the sweep's own frames best (`features_follow_probe`).
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ultragray.backends import cuda
from ultragray.datasets.sweep import IntArray, Sweep, spread_places
from ultragray.probe import FloatArray
from ultragray.samplers.rotations import blended
from ultragray.training.data.blending import Blend, blend_by_pixel, blend_in_space
from ultragray.training.data.neighbours import Neighbours

EXACT = 1e-9  # a squared error that counts as none
TRIED_FRAMES = 32  # enough to tell which blend is better
DOUBTFUL = 4.0  # times the mean difference of two frames: there their blend counts half
SMOOTHED = 11  # pixels, over which differences are averaged


@dataclass(frozen=True, eq=False)
class Places:
    """V places between two frames each, or beyond one of them: there both are the same."""

    frames: IntArray  # [V, 2]
    shares: FloatArray  # [V] of the way from the first frame to the second
    beyond_mm: FloatArray  # [V] along the elevation axis of the first; 0 between frames

    @property
    def nearer(self) -> IntArray:  # [V]
        """The frame that lies nearer."""
        return np.where(self.shares > 0.5, self.frames[:, 1], self.frames[:, 0])

    def poses(self, sweep: Sweep) -> FloatArray:  # [V, 4, 4] mm
        """The middles of the images on a straight line, the rotations on the shortest way."""
        first, second = sweep.poses[self.frames[:, 0]], sweep.poses[self.frames[:, 1]]
        middle = sweep.probe.corners_mm().mean(axis=0)
        poses = first.copy()
        poses[:, :3, :3] = blended(first[:, :3, :3], second[:, :3, :3], self.shares)
        ways = (second - first)[:, :3, :3] @ middle + (second - first)[:, :3, 3]
        starts = first[:, :3, :3] @ middle + first[:, :3, 3]
        poses[:, :3, 3] = starts + self.shares[:, None] * ways - poses[:, :3, :3] @ middle
        poses[:, :3, 3] += self.beyond_mm[:, None] * first[:, :3, 1]
        return poses


def draw_places(neighbours: Neighbours, count: int, generator: torch.Generator) -> Places:
    """Places drawn by `Neighbours.weights`, uniformly within a gap, beyond an end fewer with distance."""
    weights = torch.from_numpy(neighbours.weights)
    chosen = torch.multinomial(weights, count, replacement=True, generator=generator).numpy()
    along = torch.rand(count, generator=generator, dtype=torch.float64).numpy()
    ends = chosen - len(neighbours.pairs)  # negative: a gap
    between = ends < 0
    frames = np.empty((count, 2), np.int64)
    frames[between] = neighbours.pairs[chosen[between]]
    frames[~between] = neighbours.ends[ends[~between], None]
    beyond_mm = np.zeros(count)
    beyond_mm[~between] = neighbours.outward[ends[~between]] * neighbours.beyond_mm(along[~between])
    return Places(frames, np.where(between, along, 0.0), beyond_mm)


class Views(NamedTuple):
    """V views as a training takes them."""

    places: Places
    poses: FloatArray  # [V, 4, 4] mm
    images: Tensor  # [V, H, W] in [0, 1]
    weights: Tensor  # [V, H, W] in [0, 1], by how far the two frames agree

    def weighted(self, rendered: Tensor) -> Tensor:  # [V, H, W] -> [V, H, W]
        """A rendering to be compared with the images: mixed with them, so that it counts as much as the weights say."""
        return torch.lerp(self.images, rendered, self.weights)


class ViewsBetween:
    """Draws views with their expected images."""

    def __init__(self, sweep: Sweep, neighbours: Neighbours, images: Tensor) -> None:  # [F, H, W] uint8
        """`images` are those of the sweep, on the device of the training."""
        self._sweep, self._neighbours, self._images = sweep, neighbours, images
        self.follow_probe = features_follow_probe(sweep, neighbours)

    def draw(self, count: int, generator: torch.Generator) -> Views:
        """`count` views at places drawn by `draw_places`."""
        places = draw_places(self._neighbours, count, generator)
        blend = self._blend(places)
        differences = _smooth(blend.differences)
        usual = differences.mean(dim=(1, 2), keepdim=True).clamp(min=EXACT)  # the farther the frames, the more
        weights = blend.is_seen / (1.0 + (differences / (DOUBTFUL * usual)).square())
        return Views(places, places.poses(self._sweep), blend.images, weights)

    def _blend(self, places: Places) -> Blend:
        frames = cuda.upload(torch.from_numpy(places.frames), self._images.device)
        images = self._images[frames].float().div_(255.0)  # [V, 2, H, W]
        if self.follow_probe:
            return blend_by_pixel(images, places.shares)
        sweep = self._sweep
        return blend_in_space(images, sweep.poses[places.frames], places.poses(sweep), sweep.probe)


def _smooth(differences: Tensor) -> Tensor:  # [V, H, W] -> [V, H, W]
    """Size of the differences without speckle, which always differs."""
    half = SMOOTHED // 2
    down = functional.avg_pool2d(
        differences[:, None], (SMOOTHED, 1), stride=1, padding=(half, 0), count_include_pad=False
    )
    return functional.avg_pool2d(down, (1, SMOOTHED), stride=1, padding=(0, half), count_include_pad=False)[:, 0].abs()


def features_follow_probe(sweep: Sweep, neighbours: Neighbours) -> bool:
    """Whether frames blend better pixel by pixel than where their planes cross the plane between them.

    Tracked exactly, a structure that runs straight through the planes stays where it is in space. Poses with errors
    across the scan lines, and shadows, which turn with the probe, stay where they are in the image. Where no frame lies
    between two others, nothing tells, and it is by pixel.
    """
    beside = defaultdict(list)
    for first, second in neighbours.pairs:
        beside[first].append(second)
        beside[second].append(first)
    gains = []
    frames = np.array([frame for frame, others in beside.items() if len(others) > 1])
    for frame in frames[spread_places(len(frames), TRIED_FRAMES)]:
        pose, others = sweep.poses[frame], np.array(beside[frame])
        ways = (sweep.corners_mm()[others] - sweep.corners_mm()[frame]) @ pose[:3, 1]  # [O, K]
        heights = ways.mean(axis=1)
        if heights.min() >= 0.0 or heights.max() <= 0.0:
            continue
        above, below = heights.argmax(), heights.argmin()
        share = heights[above] / (heights[above] - heights[below])
        pair = others[[above, below]]
        truth = torch.from_numpy(sweep.images[frame]).float() / 255.0
        sides = torch.from_numpy(sweep.images[pair]).float() / 255.0
        by_pixel = torch.lerp(sides[0], sides[1], share)
        in_space = blend_in_space(sides[None], sweep.poses[None, pair], pose[None], sweep.probe).images[0]
        errors = (float((image - truth).square().mean()) + EXACT for image in (in_space, by_pixel))
        gains.append(math.log(next(errors)) - math.log(next(errors)))
    return not gains or float(np.mean(gains)) > 0.0
