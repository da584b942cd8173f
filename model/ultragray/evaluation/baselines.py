"""Classical baselines: frames predicted from the training frames themselves, without learning.

- median, mean, maximum: a compounded volume, re-sliced (ultragray.evaluation.compounding);
- linear: each pixel between the two training planes that enclose it, by its distance to them along their normals;
- nearest: the training frame whose corners lie nearest on average, as it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ultragray.datasets.sweep import Dataset, IntArray, Sweep, corner_distances_mm
from ultragray.display.scan_conversion import interpolated, pixel_places
from ultragray.errors import InvalidArgument
from ultragray.evaluation.compounding import METHODS as VOLUME_METHODS
from ultragray.evaluation.compounding import VOXEL_MM, compound, pixel_positions_mm
from ultragray.evaluation.scoring import Evaluation, evaluate_frames, require_frames
from ultragray.pose import check_poses
from ultragray.probe import FloatArray

FrameArray = npt.NDArray[np.float32]
BASELINES = (*VOLUME_METHODS, "linear", "nearest")


def predict(sweep: Sweep, poses: FloatArray, method: str, *, voxel_mm: float = VOXEL_MM) -> FrameArray:  # [C, H, W]
    """The frames, in [0, 1], that one of BASELINES expects at poses [C, 4, 4] (mm) of the sweep's own probe.

    `voxel_mm` is for the compounded volumes. Raises InvalidArgument for an unknown method, and as `compound` does.
    """
    if method not in BASELINES:
        raise InvalidArgument(f"method must be one of {', '.join(BASELINES)}, got {method!r}", field="method")
    if method == "nearest":
        return (sweep.images[nearest_frames(sweep, poses)] / 255.0).astype(np.float32)
    if method == "linear":
        return interpolate_planes(sweep, poses)
    return compound(sweep, method, voxel_mm).reslice(sweep.probe, poses, sweep.height, sweep.width)


def evaluate_baselines(
    dataset: Dataset, methods: Sequence[str] = BASELINES, voxel_mm: float = VOXEL_MM
) -> dict[str, Evaluation]:
    """The scores of each method on the held-out frames. Raises DatasetInvalid where there are none."""
    require_frames(dataset.val)
    return {
        method: evaluate_frames(predict(dataset.train, dataset.val.poses, method, voxel_mm=voxel_mm), dataset.val)
        for method in methods
    }


def nearest_frames(sweep: Sweep, poses: FloatArray) -> IntArray:  # [C]
    """The place of the sweep's frame whose corners lie nearest on average, for each pose [C, 4, 4] (mm)."""
    nearest: IntArray = _distances_to_frames_mm(sweep, poses).argmin(axis=1)
    return nearest


def interpolate_planes(sweep: Sweep, poses: FloatArray) -> FrameArray:  # [C, H, W] in [0, 1]
    """Each pixel from the nearest frame on either side of it, by the distances to their planes.

    A pixel is projected onto a frame along the frame's normal and counts where it falls into the image. With a frame on
    one side only it takes that, with none it is 0.
    """
    points = pixel_positions_mm(sweep.probe, sweep.height, sweep.width)
    order = _distances_to_frames_mm(sweep, poses).argsort(axis=1)
    planes = np.zeros((len(poses), sweep.height, sweep.width), np.float32)
    for plane, pose, frames in zip(planes, check_poses(poses) if len(poses) else poses, order, strict=True):
        plane[:] = _between(sweep, points @ pose[:3, :3].T + pose[:3, 3], frames).reshape(plane.shape)
    return planes


def _distances_to_frames_mm(sweep: Sweep, poses: FloatArray) -> FloatArray:  # [C, F]
    asked = np.einsum("cij,pj->cpi", poses[:, :3, :3], sweep.probe.corners_mm()) + poses[:, None, :3, 3]
    return corner_distances_mm(asked[:, None], sweep.corners_mm()[None])


def _between(sweep: Sweep, points: FloatArray, frames: IntArray) -> FloatArray:  # [P, 3] mm, [F] -> [P]
    """Grey values of points in the tracker's frame; `frames`, nearest first, are all tried."""
    sides = 2
    distances = np.full((sides, len(points)), np.inf)
    values = np.zeros((sides, len(points)))
    for frame in frames:
        pose = sweep.poses[frame]
        elevation = (points - pose[:3, 3]) @ pose[:3, 1]
        for side in range(sides):
            height = elevation if side == 0 else -elevation
            nearer = np.flatnonzero((height >= 0) & (height < distances[side]))
            if len(nearer):
                local = (points[nearer] - pose[:3, 3]) @ pose[:3, :3]
                inside, sampled = _sample(sweep, frame, local)
                distances[side, nearer[inside]] = height[nearer[inside]]
                values[side, nearer[inside]] = sampled
    weights = 1.0 / np.maximum(distances, 1e-9)  # 0 for a side without a frame
    total = weights.sum(axis=0)
    blended: FloatArray = (weights * values).sum(axis=0) / np.where(total > 0, total, 1.0)
    return blended


def _sample(sweep: Sweep, frame: int, local: FloatArray) -> tuple[npt.NDArray[np.bool_], FloatArray]:  # [P, 3] mm
    """A mask of the points that fall into the image when projected onto y = 0, and their bilinear values in [0, 1]."""
    rows, columns = sweep.probe.image_coordinates(local[:, 0], local[:, 2])
    inside = ~np.isnan(rows)
    image = sweep.images[frame]
    places = pixel_places(sweep.probe, image.shape, rows[inside], columns[inside])
    return inside, interpolated(image, *places) / 255.0
