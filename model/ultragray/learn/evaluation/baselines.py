"""Classical predictions of a frame, without learning: a compounded volume, the nearest frame, linear between frames,
neighbours in time.

Compounding: every pixel of every frame goes to its nearest voxel of an isotropic grid, which keeps the median, mean or
maximum of what it received. Empty voxels in the gaps between frames are filled from their neighbours, layer by layer;
what lies farther from every frame than half such a gap, or 3 mm, stays unknown. A plane is read by trilinear
interpolation between the known voxels and is 0 where none is near.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional

from ultragray import _cpu
from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.geometry.rotations import mean_axes
from ultragray.learn.evaluation.scoring import Evaluation, evaluate_frames, require_frames
from ultragray.learn.prediction import NeighboursInTime, line_numbers
from ultragray.learn.sweep import (
    ByteArray,
    Dataset,
    IntArray,
    Sweep,
    corner_distances_mm,
    nearest_frames,
    pixel_positions_mm,
)

FOLDS = ("median", "mean", "maximum")
VOXEL_MM = 0.5
MAX_VOXELS = 1 << 26
MAX_SAMPLES = 1 << 24  # sorted at once
NEIGHBOUR_WEIGHT = 0.25  # of a voxel that shares an edge, against one that shares a face; squared: only a corner
LEAST_REACH_MM = 3.0  # empty voxels are filled at least this far from a frame
TYPICAL_GAP = 0.95  # quantile: a jump of the tracker is no gap to fill
MAX_LAYERS = 24
SLAB_VOXELS = 1 << 18  # filled at once: they stay in the cache


@dataclass(frozen=True, eq=False)
class Volume:
    """A grid: voxel (x, y, z) has its centre at `origin_mm + axes @ (x, y, z) · voxel_mm` in the tracker's frame."""

    values: Tensor  # [X, Y, Z] float32 in [0, 1], 0 where unknown
    known: Tensor  # [X, Y, Z] float32, 1 or 0
    axes: FloatArray  # [3, 3], its columns are the axes of the grid
    origin_mm: FloatArray  # [3]
    voxel_mm: float

    def reslice(self, probe: Probe, poses: FloatArray, height: int, width: int) -> npt.NDArray[np.float32]:  # [C, H, W]
        """The planes that a probe sees from poses [C, 4, 4] (mm, probe→tracker); 0 where no known voxel is near."""
        points = pixel_positions_mm(probe, height, width)
        volume = torch.stack([self.values, self.known])[None]  # [1, 2, X, Y, Z]
        last = np.array(self.values.shape) - 1
        planes = np.zeros((len(poses), height, width), np.float32)
        for plane, pose in zip(planes, check_poses(poses), strict=True):
            places = _on_grid(points, pose, self.axes, self.origin_mm, self.voxel_mm) * (2.0 / last) - 1.0
            grid = torch.from_numpy(places[:, ::-1].astype(np.float32))  # grid_sample wants the last axis first
            value, known = functional.grid_sample(volume, grid[None, None, None], align_corners=True)[0, :, 0, 0]
            plane[:] = torch.where(known > 0, value / known.clamp_min(1e-6), 0.0).view(height, width).numpy()
        return planes


def compound(sweep: Sweep, method: str = "median", voxel_mm: float = VOXEL_MM) -> Volume:
    """The volume of a sweep; `method` is median, mean or maximum.

    Raises InvalidArgument for another method, and for voxels so small that the grid would not fit into memory.
    """
    if method not in FOLDS:
        raise InvalidArgument(f"method must be one of {', '.join(FOLDS)}, got {method!r}", field="method")
    if not (math.isfinite(voxel_mm) and voxel_mm > 0):
        raise InvalidArgument(f"voxel_mm must be a positive length in mm, got {voxel_mm!r}", field="voxel_mm")
    axes = mean_axes(sweep.poses)  # the tightest box
    low, high = _extent_mm(sweep, axes)
    counts = _counts(high - low, voxel_mm)
    if math.prod(counts) > MAX_VOXELS:
        span = " x ".join(f"{side:.0f}" for side in high - low)
        raise InvalidArgument(
            f"voxel_mm must be at least {affordable_voxel_mm(sweep, voxel_mm):g} for {sweep.source}, whose frames span "
            f"{span} mm, got {voxel_mm:g}",
            field="voxel_mm",
        )
    origin_mm = axes @ low
    values = np.zeros(math.prod(counts), np.float32)
    known = np.zeros(math.prod(counts), np.float32)
    for voxels, folded in _folded(sweep, axes, origin_mm, voxel_mm, counts, method):
        values[voxels] = folded / 255.0
        known[voxels] = 1.0
    filled = _fill_gaps(
        torch.from_numpy(values).view(counts), torch.from_numpy(known).view(counts), _layers(sweep, voxel_mm)
    )
    return Volume(*filled, axes=axes, origin_mm=origin_mm, voxel_mm=voxel_mm)


def affordable_voxel_mm(sweep: Sweep, wanted_mm: float = VOXEL_MM) -> float:
    """The voxel that was wanted, or the smallest (to 0.01 mm) with which a grid around the sweep fits into memory."""
    low, high = _extent_mm(sweep, mean_axes(sweep.poses))
    if math.prod(_counts(high - low, wanted_mm)) <= MAX_VOXELS:
        return wanted_mm
    hundredths = math.ceil(100.0 * wanted_mm)
    while math.prod(_counts(high - low, hundredths / 100.0)) > MAX_VOXELS:
        hundredths += 1
    return hundredths / 100.0


def _on_grid(
    points: FloatArray,  # [P, 3] mm, probe frame
    pose: FloatArray,  # [4, 4] mm
    axes: FloatArray,
    origin_mm: FloatArray,
    voxel_mm: float,
) -> FloatArray:  # [P, 3] voxels
    rotation = axes.T @ pose[:3, :3] / voxel_mm
    return points @ rotation.T + axes.T @ (pose[:3, 3] - origin_mm) / voxel_mm


def _extent_mm(sweep: Sweep, axes: FloatArray) -> tuple[FloatArray, FloatArray]:  # [3], [3]
    """Least and greatest coordinate of the sweep's pixels along `axes`."""
    image = pixel_positions_mm(sweep.probe, sweep.height, sweep.width).reshape(sweep.height, sweep.width, 3)
    edge = np.concatenate([image[[0, -1]].reshape(-1, 3), image[:, [0, -1]].reshape(-1, 3)])
    seen = [_on_grid(edge, pose, axes, np.zeros(3), 1.0) for pose in sweep.poses]
    return np.min([places.min(axis=0) for places in seen], axis=0), np.max([p.max(axis=0) for p in seen], axis=0)


def _counts(span_mm: FloatArray, voxel_mm: float) -> tuple[int, int, int]:
    """Voxels along each axis: at least two, since along an axis of one `grid_sample` takes any place for that one."""
    x, y, z = (max(2, int(count)) for count in np.ceil(span_mm / voxel_mm) + 1)
    return x, y, z


def _folded(
    sweep: Sweep, axes: FloatArray, origin_mm: FloatArray, voxel_mm: float, counts: tuple[int, int, int], method: str
) -> Iterator[tuple[IntArray, FloatArray]]:
    """Voxels that received a sample, and the median, mean or maximum of their samples, 0 to 255.

    Samples are sorted by voxel, then grey value, in ranges of voxels that bound the memory.
    """
    points = pixel_positions_mm(sweep.probe, sweep.height, sweep.width)
    passes = math.ceil(sweep.images.size / MAX_SAMPLES)
    for low, high in pairwise(np.linspace(0, math.prod(counts), passes + 1).astype(np.int64)):
        parts = []
        for image, pose in zip(sweep.images, sweep.poses, strict=True):
            x, y, z = np.rint(_on_grid(points, pose, axes, origin_mm, voxel_mm)).astype(np.int64).T
            voxel = (x * counts[1] + y) * counts[2] + z
            keys = voxel * 256 + image.ravel()
            parts.append(keys if passes == 1 else keys[(voxel >= low) & (voxel < high)])
        keys = np.concatenate(parts)
        del parts
        keys.sort()
        voxels, grey = keys >> 8, (keys & 255).astype(np.uint8)
        starts = np.flatnonzero(np.diff(voxels, prepend=-1))
        sizes = np.diff(starts, append=len(voxels))
        yield voxels[starts], _FOLDED[method](grey, starts, sizes)


# Of the grey values of all voxels, sorted in each: the first place of each voxel, and how many it has.
_FOLDED: dict[str, Callable[[ByteArray, IntArray, IntArray], FloatArray]] = {
    "median": lambda grey, starts, sizes: (
        (grey[starts + (sizes - 1) // 2].astype(np.float64) + grey[starts + sizes // 2]) / 2.0
    ),
    "mean": lambda grey, starts, sizes: (
        np.add.reduceat(grey, starts, dtype=np.float64) / sizes if len(starts) else np.zeros(0)
    ),
    "maximum": lambda grey, starts, sizes: grey[starts + sizes - 1].astype(np.float64),
}


def _layers(sweep: Sweep, voxel_mm: float) -> int:
    """Layers that reach the middle of the gap between neighbouring frames, where their corners are farthest apart."""
    corners = sweep.corners_mm()
    gaps_mm = []
    for place, own in enumerate(corners):
        distances = corner_distances_mm(corners, own)  # [F]
        distances[place] = np.inf
        gaps_mm.append(np.linalg.norm(corners[distances.argmin()] - own, axis=-1).max())
    reach_mm = max(LEAST_REACH_MM, float(np.quantile(gaps_mm, TYPICAL_GAP)) / 2.0)
    return min(MAX_LAYERS, math.ceil(reach_mm / voxel_mm))


def _fill_gaps(values: Tensor, known: Tensor, layers: int) -> tuple[Tensor, Tensor]:  # [X, Y, Z] each
    """Gives each empty voxel that touches known ones their weighted mean; `layers` times over."""
    thickness = max(1, SLAB_VOXELS // (values.shape[1] * values.shape[2]))
    for _ in range(layers):
        grown_values, grown_known = values.clone(), known.clone()
        for first in range(0, values.shape[0], thickness):
            around = slice(max(first - 1, 0), first + thickness + 1)
            inside = slice(first - around.start, first - around.start + thickness)
            weights = _spread(known[around])[inside]
            means = _spread(values[around])[inside] / weights.clamp_min(1e-6)  # unknown values are 0
            slab = slice(first, first + thickness)
            empty = (known[slab] == 0) & (weights > 0)
            grown_values[slab] = torch.where(empty, means, values[slab])
            grown_known[slab].masked_fill_(empty, 1.0)
        values, known = grown_values, grown_known
    return values, known


def _spread(grid: Tensor) -> Tensor:  # [X, Y, Z]
    """Each voxel plus NEIGHBOUR_WEIGHT times its two neighbours, along one axis after the other."""
    for axis in range(3):
        count = grid.shape[axis] - 1
        spread = grid.clone()
        spread.narrow(axis, 1, count).add_(grid.narrow(axis, 0, count), alpha=NEIGHBOUR_WEIGHT)
        spread.narrow(axis, 0, count).add_(grid.narrow(axis, 1, count), alpha=NEIGHBOUR_WEIGHT)
        grid = spread
    return grid


FrameArray = npt.NDArray[np.float32]
BY_POSE = (*FOLDS, "linear", "nearest")
IN_TIME = "in-time"
BASELINES = (*BY_POSE, IN_TIME)


def predict(sweep: Sweep, poses: FloatArray, method: str, *, voxel_mm: float = VOXEL_MM) -> FrameArray:  # [C, H, W]
    """The frames, in [0, 1], that one of BY_POSE expects at poses [C, 4, 4] (mm) of the sweep's own probe.

    `nearest`: the frame whose corners lie nearest on average. `linear`: `interpolate_planes`. The others: a compounded
    volume of voxels of `voxel_mm`, re-sliced. Raises InvalidArgument for an unknown method, and as `compound` does.
    """
    if method not in BY_POSE:
        raise InvalidArgument(f"method must be one of {', '.join(BY_POSE)}, got {method!r}", field="method")
    if method == "nearest":
        return (sweep.images[nearest_frames(sweep, poses)] / 255.0).astype(np.float32)
    if method == "linear":
        return interpolate_planes(sweep, poses)
    return compound(sweep, method, voxel_mm).reslice(sweep.probe, poses, sweep.height, sweep.width)


def predict_held_out(dataset: Dataset, method: str, *, voxel_mm: float = VOXEL_MM) -> FrameArray:  # [V, H, W]
    """The held-out frames, in [0, 1], that one of BASELINES expects.

    `in-time`: each is the blend of the training frames before and after it, by their times and pixel by pixel, whatever
    the poses. Raises DatasetInvalid where frames have no neighbours in time, and as `predict` does.
    """
    if method == IN_TIME:
        return NeighboursInTime.of(dataset).frames_of(dataset.train)
    return predict(dataset.train, dataset.val.poses, method, voxel_mm=voxel_mm)


def evaluate_baselines(
    dataset: Dataset, methods: Sequence[str] = BASELINES, voxel_mm: float = VOXEL_MM
) -> dict[str, Evaluation]:
    """The scores of these methods on the held-out frames, without `in-time` where frames have no neighbours in time.

    Raises DatasetInvalid where nothing is held out.
    """
    require_frames(dataset.val)
    return {
        method: evaluate_frames(predict_held_out(dataset, method, voxel_mm=voxel_mm), dataset.val)
        for method in methods
        if method != IN_TIME or dataset.places is not None
    }


def interpolate_planes(sweep: Sweep, poses: FloatArray, frames: IntArray | None = None) -> FrameArray:
    """Each pixel [C, H, W], in [0, 1], from the nearest frame on either side of it, by the distances to their planes.

    A pixel is projected onto a frame along the frame's normal and counts where it falls into the image. With a frame on
    one side only it takes that, with none it is 0. `frames` [C, K] are those that each pose is predicted from, the ones
    before -1 where there are fewer; None: all of them.
    """
    if frames is None:
        corners = sweep.probe.corners_from(poses)
        frames = corner_distances_mm(corners[:, None], sweep.corners_mm()[None]).argsort(axis=1)
    points = pixel_positions_mm(sweep.probe, sweep.height, sweep.width)
    planes = np.empty((len(poses), sweep.height, sweep.width), np.float32)
    _cpu.interpolate_planes(
        images=np.ascontiguousarray(sweep.images),
        image_poses=np.ascontiguousarray(sweep.poses),
        poses=np.ascontiguousarray(check_poses(poses)),
        frames=np.ascontiguousarray(frames),
        pixels=np.ascontiguousarray(points[:, ::2].T, np.float32),
        lines=line_numbers(sweep.probe),
        threads=torch.get_num_threads(),
        planes=planes,
    )
    return planes
