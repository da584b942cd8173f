"""The place of a pose relative to the views that a scene was trained on. Needs no torch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ultragray.pose import check_poses
from ultragray.probe import FloatArray, Probe

POINTS_PER_SIDE = 6  # of the grid of image points at which distances are taken
ANGLE_MM_PER_DEG = 0.02  # added to distances to choose the nearest view: of two about as near, the less turned one
FAR_MM = 20.0  # a frame is expected to be no worse farther away: larger distances count as this
MAX_VIEWS = 256  # around a pose that it is compared with: with more, this would take longer than rendering the frame
SMALLEST_MM = 1e-6  # of a distance: nearer ones count as this
POSES_AT_ONCE = 8  # so that their distances stay in the processor's cache
NEIGHBOURHOOD_MM = 3.0  # of views whose hardness counts; where all are farther away, the nearest ones count


@dataclass(frozen=True, eq=False)
class ViewMeasures:
    """Of K points of the images of C poses, row by row, and the weights of the P training views around each pose.

    distance: to the nearest training image. interpolation: a·b/(a + b) of the distances a, b to the nearest images on
    either side: half of either midway between two, all of it where there is one side only. Both count as at most
    FAR_MM; `nearest_mm` is the distance without that limit. angle: the rotation to the view of the nearest image.
    """

    nearest_mm: FloatArray  # [C, K]
    distance_mm: FloatArray  # [C, K]
    interpolation_mm: FloatArray  # [C, K]
    angle_deg: FloatArray  # [C, K]
    weights: FloatArray  # [C, P], each row sums to 1

    def averaged(self) -> ViewMeasures:
        """The same with the mean over the points as the only one."""
        return ViewMeasures(
            nearest_mm=self.nearest_mm.mean(axis=1, keepdims=True),
            distance_mm=self.distance_mm.mean(axis=1, keepdims=True),
            interpolation_mm=self.interpolation_mm.mean(axis=1, keepdims=True),
            angle_deg=self.angle_deg.mean(axis=1, keepdims=True),
            weights=self.weights,
        )


class TrainingViews:
    """The images of P training poses [P, 4, 4] (mm, probe→scene) of one probe, in space. P is at least 1."""

    def __init__(self, poses: FloatArray, probe: Probe) -> None:
        self._probe = probe
        axes = np.ascontiguousarray(poses[:, :3, :3].transpose(2, 1, 0))  # [axis, xyz, P]
        self._axes = axes.astype(np.float32)
        self._offsets = np.einsum("axp,px->ap", axes, poses[:, :3, 3]).astype(np.float32)  # [axis, P]
        self._rotations = poses[:, :3, :3].reshape(len(poses), 9)
        self._middles = (
            poses[:, :3, :3] @ _image_points(probe, POINTS_PER_SIDE).mean(axis=0) + poses[:, :3, 3]
        )  # [P, 3] mm

    def __len__(self) -> int:
        return len(self._rotations)

    def measure(self, poses: FloatArray, probe: Probe, points_per_side: int = POINTS_PER_SIDE) -> ViewMeasures:
        """Measures poses [C, 4, 4] (mm) of a probe, which need not be the views' own. Raises InvalidPose."""
        points = _image_points(probe, points_per_side)
        count = len(poses)
        measures = np.zeros((4, count, len(points)))
        weights = np.zeros((count, len(self)))
        checked = check_poses(poses) if count else poses
        for first in range(0, count, POSES_AT_ONCE):
            some = checked[first : first + POSES_AT_ONCE]
            places = np.arange(first, first + len(some))
            seen = points @ some[:, :3, :3].transpose(0, 2, 1) + some[:, None, :3, 3]
            views = self._nearby(seen.mean(axis=1))
            measures[:, places], weights[places[:, None], views] = self._measure(seen, some, views)
        nearest, distance, interpolation, angle = measures
        return ViewMeasures(nearest, distance, interpolation, angle, weights)

    def mean_distances_mm(self, poses: FloatArray, probe: Probe) -> FloatArray:  # [C, P]
        """Root of the mean square distance of the points of each image to each view."""
        points = _image_points(probe, POINTS_PER_SIDE)
        distances = np.zeros((len(poses), len(self)))
        everyone = np.arange(len(self))[None]
        for place, pose in enumerate(poses):
            _, apart = self._offsets_mm((points @ pose[:3, :3].T + pose[:3, 3])[None], everyone)
            distances[place] = _root_mean_square(apart)[0]
        return distances

    def _nearby(self, middles: FloatArray) -> npt.NDArray[np.intp]:  # [B, 3] mm -> [B, V] or [1, P]
        """The views that can matter: all, or of very many those whose images have their middles nearest to a point."""
        if len(self) <= MAX_VIEWS:
            return np.arange(len(self))[None]
        away = ((self._middles - middles[:, None]) ** 2).sum(axis=2)
        return np.argpartition(away, MAX_VIEWS, axis=1)[:, :MAX_VIEWS]

    def _offsets_mm(
        self, points: FloatArray, views: npt.NDArray[np.intp]
    ) -> tuple[FloatArray, FloatArray]:  # [B, K, 3] mm, [B, V] -> [B, K, V] both
        """Distances of points off the planes of views along elevation, and from the images within the planes.

        In float32, and squares are added up here: `np.hypot` of doubles takes ten times as long.
        """
        single = points.astype(np.float32)
        x, elevation, z = (single @ self._axes[axis][:, views].transpose(1, 0, 2) for axis in range(3))
        for coordinate, offsets in zip((x, elevation, z), self._offsets, strict=True):
            coordinate -= offsets[views][:, None]
        probe = self._probe
        lateral, depth = probe.lines.beside(x, z)
        depth -= 0.5 * (probe.near_mm + probe.far_mm)
        axial = np.abs(depth, out=depth)
        axial -= 0.5 * probe.scan_line_length_mm
        squares = elevation * elevation
        for beside in (lateral, axial):
            np.maximum(beside, 0.0, out=beside)
            beside *= beside
            squares += beside
        return elevation, np.sqrt(squares, out=squares)

    def _measure(
        self, points: FloatArray, poses: FloatArray, views: npt.NDArray[np.intp]
    ) -> tuple[FloatArray, FloatArray]:  # [B, K, 3], [B, 4, 4], [B, V] -> [4, B, K], [B, V]
        along, distances = self._offsets_mm(points, views)  # [B, K, V]
        angles = np.take_along_axis(self._angles_deg(poses), views, axis=1)[:, None].astype(np.float32)
        nearest = (distances + np.float32(ANGLE_MM_PER_DEG) * angles).argmin(axis=2)[..., None]
        nearest_mm = np.take_along_axis(distances, nearest, axis=2)[..., 0]
        facing = np.einsum("xbv,bx->bv", self._axes[1][:, views], poses[:, :3, 1])
        along *= np.sign(facing)[:, None]  # −1: turned by more than 90°, front and back swap
        largest = np.float32(1e3 * FAR_MM)  # of a side without a view
        np.clip(distances, SMALLEST_MM, largest, out=distances)
        nearness = np.copysign(1.0 / distances, along)  # the nearest view in front has the highest, behind the lowest
        front, back = (1.0 / np.maximum(side, 1.0 / largest) for side in (nearness.max(axis=2), -nearness.min(axis=2)))
        between = front * back / np.maximum(front + back, 1e-9)
        capped = [np.minimum(value, FAR_MM) for value in (nearest_mm, between)]
        around = _root_mean_square(distances)
        least = around.min(axis=1, keepdims=True)
        reach = np.maximum(NEIGHBOURHOOD_MM, 1.3 * least)
        weights = np.exp((least / reach) ** 2 - (around / reach) ** 2)
        turned = np.take_along_axis(np.broadcast_to(angles, distances.shape), nearest, axis=2)[..., 0]
        return np.stack([nearest_mm, *capped, turned]), weights / weights.sum(axis=1, keepdims=True)

    def _angles_deg(self, poses: FloatArray) -> FloatArray:  # [B, 4, 4] -> [B, P]
        """Angle of the rotation from each pose to each view."""
        cosine = 0.5 * (poses[:, :3, :3].reshape(-1, 9) @ self._rotations.T - 1.0)
        return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _image_points(probe: Probe, per_side: int) -> FloatArray:  # [K, 3] mm, probe frame
    origins, directions = probe.scan_lines(per_side)
    points = origins + probe.depths_mm(per_side)[:, None, None] * directions
    return points.reshape(-1, 3)


def _root_mean_square(values: FloatArray) -> FloatArray:  # [B, K, P] -> [B, P]
    root: FloatArray = np.sqrt(np.einsum("bkp,bkp->bp", values, values) / values.shape[1]).astype(np.float64)
    return root
