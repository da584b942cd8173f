"""The place of a pose relative to the views that a scene was trained on. Needs no torch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..pose import check_poses
from ..probe import FloatArray, Probe

POINTS_PER_SIDE = 6  # of the grid of image points at which distances are taken
ANGLE_MM_PER_DEG = 0.02  # added to distances to choose the nearest view: of two about as near, the less turned one
FAR_MM = 20.0  # a frame is expected to be no worse farther away: larger distances count as this
MAX_VIEWS = 256  # around a pose that it is compared with: with more, this would take longer than rendering the frame
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
        self._axes = np.ascontiguousarray(poses[:, :3, :3].transpose(2, 1, 0))  # [axis, xyz, P]
        self._offsets = np.einsum("axp,px->ap", self._axes, poses[:, :3, 3])  # [axis, P]
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
        for place, pose in enumerate(check_poses(poses) if count else poses):
            seen = points @ pose[:3, :3].T + pose[:3, 3]
            views = self._nearby(seen.mean(axis=0))
            measures[:, place], weights[place, views] = self._measure(seen, pose, views)
        nearest, distance, interpolation, angle = measures
        return ViewMeasures(nearest, distance, interpolation, angle, weights)

    def mean_distances_mm(self, poses: FloatArray, probe: Probe) -> FloatArray:  # [C, P]
        """Root of the mean square distance of the points of each image to each view."""
        points = _image_points(probe, POINTS_PER_SIDE)
        distances = np.zeros((len(poses), len(self)))
        for place, pose in enumerate(poses):
            elevation, beside = self._offsets_mm(points @ pose[:3, :3].T + pose[:3, 3], slice(None))
            distances[place] = _root_mean_square(np.hypot(elevation, beside))
        return distances

    def _nearby(self, point: FloatArray) -> slice | npt.NDArray[np.intp]:
        """The views that can matter: all, or of very many those whose images have their middles nearest to a point."""
        if len(self) <= MAX_VIEWS:
            return slice(None)
        return np.argpartition(((self._middles - point) ** 2).sum(axis=1), MAX_VIEWS)[:MAX_VIEWS]

    def _offsets_mm(
        self, points: FloatArray, views: slice | npt.NDArray[np.intp]
    ) -> tuple[FloatArray, FloatArray]:  # [K, 3] mm -> [K, P] both
        """Distances of points off the planes of views along elevation, and beside the images within the planes."""
        x, elevation, z = (points @ self._axes[axis][:, views] - self._offsets[axis][views] for axis in range(3))
        probe = self._probe
        lateral, depth = probe.lines.beside(x, z)
        middle, reach = 0.5 * (probe.near_mm + probe.far_mm), 0.5 * probe.scan_line_length_mm
        axial = np.abs(depth - middle) - reach
        return elevation, np.hypot(np.maximum(lateral, 0.0), np.maximum(axial, 0.0))

    def _measure(
        self, points: FloatArray, pose: FloatArray, views: slice | npt.NDArray[np.intp]
    ) -> tuple[FloatArray, FloatArray]:  # [4, K], [V]
        elevation, beside = self._offsets_mm(points, views)
        angles = self._angles_deg(pose)[views]
        distances = np.hypot(elevation, beside)  # [K, P]
        nearest = (distances + ANGLE_MM_PER_DEG * angles).argmin(axis=1)
        nearest_mm = distances[np.arange(len(points)), nearest]
        facing = np.sign(self._axes[1][:, views].T @ pose[:3, 1])  # −1: turned by more than 90°, front and back swap
        along = elevation * facing
        sides = [np.where(side, distances, np.inf).min(axis=1) for side in (along >= 0.0, along <= 0.0)]
        front, back = (np.minimum(side, 1e3 * FAR_MM) for side in sides)
        between = front * back / np.maximum(front + back, 1e-9)
        capped = [np.minimum(value, FAR_MM) for value in (nearest_mm, between)]
        around = _root_mean_square(np.minimum(distances, 1e3 * FAR_MM))
        least = around.min()
        reach = max(NEIGHBOURHOOD_MM, 1.3 * least)
        weights = np.exp((least / reach) ** 2 - (around / reach) ** 2)
        return np.stack([nearest_mm, *capped, angles[nearest]]), weights / weights.sum()

    def _angles_deg(self, pose: FloatArray) -> FloatArray:  # [P]
        """Angle of the rotation from the pose to each view."""
        cosine = 0.5 * (self._rotations @ pose[:3, :3].ravel() - 1.0)
        return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _image_points(probe: Probe, per_side: int) -> FloatArray:  # [K, 3] mm, probe frame
    origins, directions = probe.scan_lines(per_side)
    points = origins + probe.depths_mm(per_side)[:, None, None] * directions
    return points.reshape(-1, 3)


def _root_mean_square(values: FloatArray) -> FloatArray:  # [K, P] -> [P]
    root: FloatArray = np.sqrt((values * values).mean(axis=0))
    return root
