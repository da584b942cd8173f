"""Views between the frames: their neighbours, the blend of these, and the views that a step draws."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ultragray import _cpu
from ultragray.geometry.probe import FloatArray, Lines, ParallelLines, Probe
from ultragray.geometry.rotations import blended, rotation_angles_deg
from ultragray.learn.prediction import ON_PLANE_MM, line_numbers
from ultragray.learn.sweep import IntArray, Sweep, spread_places
from ultragray.rendering.backends import cuda

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
        return replace(self, ends=self.ends[:0], outward=self.outward[:0])

    @cached_property
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
        heights_mm = offsets[nearest[0]] @ pose[:3, 1] if len(nearest) else np.zeros(1)
        low, high = float(heights_mm.min()), float(heights_mm.max())
        if min(-low, high) > CROSSING * max(-low, high):  # evenly: not as frames of a tilt do, whose faces meet
            neighbours = nearest.tolist()
        else:
            neighbours = []
            for side in (1, -1):
                ahead = side * across
                near = np.flatnonzero(candidates & (ahead > LEAST_ACROSS * distances))
                if len(near):
                    neighbours.append(int(near[distances[near].argmin()]))
                elif not ((ahead > 0) & (ahead < extent_mm) & ~beside).any():
                    alone.append((place, side))
        pairs |= {(min(place, other), max(place, other)): float(distances[other]) for other in neighbours}
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


class Blend(NamedTuple):
    """V planes, and by how much the two frames differ there."""

    images: Tensor  # [V, H, W] in [0, 1]
    differences: Tensor  # [V, H, W] second less first; 0 where only one frame shows the pixel
    is_seen: Tensor  # [V, H, W] whether at least one does


def blend_by_pixel(images: Tensor, shares: FloatArray) -> Blend:  # [V, 2, H, W] in [0, 1], [V]
    """Each pixel from the same pixel of both frames; `shares` are those of the second one."""
    first, second = images.unbind(1)
    weights = cuda.upload(torch.from_numpy(shares).float(), images.device)
    blended = torch.lerp(first, second, weights[:, None, None])
    return Blend(blended, second - first, torch.ones_like(blended, dtype=torch.bool))


def blend_in_space(
    images: Tensor,  # [V, 2, H, W] in [0, 1], on any device
    frame_poses: FloatArray,  # [V, 2, 4, 4] mm
    poses: FloatArray,  # [V, 4, 4] mm, of the planes between
    probe: Probe,
) -> Blend:
    """The planes, as the baseline `linear` of `ultragray.learn.evaluation` predicts them from two frames.

    Each pixel is projected onto both frames along their normals; their grey values there count in inverse proportion to
    the distances. A frame that the projection misses does not count; where it misses both, the pixel is 0.
    """
    views, _, height, width = images.shape
    rows, columns, distances = _projected(frame_poses.reshape(-1, 4, 4), np.repeat(poses, 2, axis=0), probe, images)
    sources = images.reshape(2 * views, 1, height, width)
    inside = (rows >= 0.0) & (rows <= 1.0)
    if probe.lines.wrap:
        sources = functional.pad(sources, (1, 1, 0, 0), mode="circular")
        columns = (columns % 1.0 * width + 1.0) / (width + 2)
    else:
        inside &= (columns >= 0.0) & (columns <= 1.0)
    places = torch.stack([2.0 * columns - 1.0, 2.0 * rows - 1.0], dim=-1)
    values = functional.grid_sample(sources, places, padding_mode="border", align_corners=False).reshape(images.shape)
    weights = torch.where(inside, 1.0 / distances.clamp(min=ON_PLANE_MM), 0.0).reshape(images.shape)
    is_in = inside.reshape(images.shape)
    blended = (weights * values).sum(dim=1) / weights.sum(dim=1).clamp(min=1e-9)
    return Blend(blended, (values[:, 1] - values[:, 0]) * is_in.all(dim=1), is_in.any(dim=1))


def _projected(
    onto: FloatArray,  # [P, 4, 4] mm
    poses: FloatArray,  # [P, 4, 4] mm
    probe: Probe,
    like: Tensor,  # [..., H, W], whose size and device the result has
) -> tuple[Tensor, Tensor, Tensor]:  # three of [P, H, W]
    """Where each pixel of an image falls on another one: row and column, from 0 to 1, and its distance (mm)."""
    height, width = like.shape[-2:]
    maps = cuda.upload(torch.from_numpy(_maps(onto, poses)).float(), like.device)
    local = maps @ _pixels(probe, height, width, like.device)
    x, y, z = local.reshape(-1, 3, height, width).unbind(1)
    depth, across = _on_lines(probe.lines, x, z)
    rows = (depth - probe.near_mm) / probe.scan_line_length_mm
    return rows, (across - probe.lines.start) / probe.lines.span, y.abs()


def _maps(onto: FloatArray, poses: FloatArray) -> FloatArray:  # [P, 4, 4] both, mm -> [P, 3, 3]
    """From the x and the z of a point in the plane of a pose, and 1, to its place as `onto` has it."""
    turns = np.einsum("pji,pjk->pik", onto[:, :3, :3], poses[:, :3, :3])
    shifts = np.einsum("pji,pj->pi", onto[:, :3, :3], poses[:, :3, 3] - onto[:, :3, 3])
    return np.stack([turns[:, :, 0], turns[:, :, 2], shifts], axis=-1)


@lru_cache(maxsize=4)
def _pixels(probe: Probe, height: int, width: int, device: torch.device) -> Tensor:  # [3, H·W]
    """x and z of each pixel of an image in its own frame (mm), and ones."""
    shares = [(np.arange(size) + 0.5) / size for size in (height, width)]
    x, _, z = np.moveaxis(probe.points_mm(*np.meshgrid(*shares, indexing="ij")), -1, 0)
    return torch.from_numpy(np.stack([x, z, np.ones_like(x)]).reshape(3, -1)).float().to(device)


def _on_lines(lines: Lines, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """`lines.coordinates` of tensors on any device; angles beyond the lines are not cut off."""
    if isinstance(lines, ParallelLines):
        along_x, along_z = lines.direction
        return z / along_z, x - z * (along_x / along_z)
    return torch.hypot(x, z), torch.rad2deg(torch.atan2(x, z))


# Views between the frames of a sweep, and beyond its ends: what the frames on either side say that a plane shows.
#
# Frames show only the edges of the gap between them, and a training could put anything inside. So it also sees planes
# between neighbouring frames (`neighbours_of`), at a place drawn anew each time, with the two frames blended by their
# distances, in the way that predicts the sweep's own frames best (`features_follow_probe`).

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


class ViewsBetween:
    """Draws views with their expected images."""

    def __init__(
        self,
        sweep: Sweep,
        neighbours: Neighbours,
        images: Tensor,  # [F, H, W] uint8
        *,
        follow_probe: bool | None = None,
    ) -> None:
        """`images` are those of the sweep, on the device of the training; `follow_probe`: None: the sweep tells."""
        self._sweep, self._neighbours, self._images = sweep, neighbours, images
        self.follow_probe = features_follow_probe(sweep, neighbours) if follow_probe is None else follow_probe

    def draw(self, count: int, generator: torch.Generator) -> Views:
        """`count` views at places drawn by `draw_places`."""
        places = draw_places(self._neighbours, count, generator)
        poses = places.poses(self._sweep)
        show = self.shown if self._images.device.type == "cpu" else self.plainly_shown
        return Views(places, poses, *show(places, poses))

    def plainly_shown(self, places: Places, poses: FloatArray) -> tuple[Tensor, Tensor]:  # [V, H, W] both
        """The expected images of views and their weights, on any device: the definition of `shown`."""
        blend = self._blend(places, poses)
        differences = smoothed_sizes(blend.differences)
        usual = differences.mean(dim=(1, 2), keepdim=True).clamp(min=EXACT)  # the farther the frames, the more
        return blend.images, blend.is_seen / (1.0 + (differences / (DOUBTFUL * usual)).square())

    def _blend(self, places: Places, poses: FloatArray) -> Blend:
        frames = cuda.upload(torch.from_numpy(places.frames), self._images.device)
        images = self._images[frames].float().div_(255.0)  # [V, 2, H, W]
        if self.follow_probe:
            return blend_by_pixel(images, places.shares)
        sweep = self._sweep
        return blend_in_space(images, sweep.poses[places.frames], poses, sweep.probe)

    def shown(self, places: Places, poses: FloatArray) -> tuple[Tensor, Tensor]:  # [V, H, W] both
        """The same by the C++ kernel, for images on the CPU."""
        sweep, onto, pixels = self._sweep, None, None
        if not self.follow_probe:
            maps = _maps(sweep.poses[places.frames].reshape(-1, 4, 4), np.repeat(poses, 2, axis=0))
            onto = maps.reshape(-1, 2, 3, 3).astype(np.float32)
            pixels = _pixels(sweep.probe, sweep.height, sweep.width, self._images.device)[:2].numpy()
        images, weights = torch.empty((2, len(poses), sweep.height, sweep.width))
        _cpu.blend_between(
            images=self._images.numpy(),
            frames=places.frames,
            shares=places.shares.astype(np.float32),
            onto=onto,
            pixels=pixels,
            lines=line_numbers(sweep.probe),
            smoothed=SMOOTHED,
            doubtful=DOUBTFUL,
            nothing=EXACT,
            threads=torch.get_num_threads(),
            blends=images.numpy(),
            weights=weights.numpy(),
        )
        return images, weights


def smoothed_sizes(differences: Tensor) -> Tensor:  # [V, H, W] -> [V, H, W]
    """Sizes of the differences without speckle, which always differs: averaged over squares that end with the image."""
    return _running_mean(_running_mean(differences, dim=1), dim=2).abs()


def _running_mean(values: Tensor, dim: int) -> Tensor:
    """Over SMOOTHED places of a dimension, by sums from its beginning: faster than torch's pooling on a CPU."""
    size, half = values.shape[dim], SMOOTHED // 2
    places = torch.arange(size, device=values.device)
    first, stop = (places - half).clamp(min=0), (places + half + 1).clamp(max=size)
    sums = functional.pad(values.cumsum(dim), (0, 0, 1, 0) if dim == 1 else (1, 0))
    shape = (-1, 1) if dim == 1 else (-1,)
    return (sums.index_select(dim, stop) - sums.index_select(dim, first)) / (stop - first).view(shape)


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
