"""Contact of a probe with the skin: which scan lines have it, and how far the face is pressed in. Needs no torch.

A scene's training poses tell its `Skin`, the skin and a probe at poses their `Touch`. `ultragray.rendering.frames` asks
for them first; what pressing does to the tissue is in `ultragray.rendering.pressing`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.geometry.scan_conversion import interpolated

# The skin as a sweep tells it: heights of the faces of its training views over a plane.
#
# Where the probe was, there was skin, pressed now more and now less. The skin at rest is taken to be where the
# outermost face was, and the most that is known of it to give way is where the innermost face was: a training view is
# neither in the air nor pressed beyond what was recorded.

HeightArray: TypeAlias = npt.NDArray[np.float32]

COUPLING_MM = 1.0  # of gel between face and skin: a face so near to the skin has contact
MARGIN_MM = 15.0  # beyond the training faces the skin goes on, at the height of the nearest ones
LEAST_SLOPE = 0.2  # cosine between a scan line and the way into the body: a flatter line has no contact
_LEAST_AGREEMENT = 0.6  # length of the views' mean axis, 1 where all look one way: around a limb there is no height
_LEAST_CELL_MM = 1.0
_MOST_CELLS = 256  # each way
_MOST_VIEWS = 4096  # of more, every second one is taken, or every third
_SETTLED = 8  # times what lies between the faces is smoothed
_STEPS, _MET_MM = 6, 1e-3  # of Newton's method towards the surface, at most, and until it moves no farther


@dataclass(frozen=True, eq=False)
class Skin:
    """Heights of the outermost and the innermost training face over a plane, in cells. Made by `Skin.under`."""

    origin: FloatArray  # [3] mm: the centre of the first cell, at height 0
    axes: FloatArray  # [3, 3]: unit vectors along the cells of a row, of a column, and out of the body
    cell_mm: float
    outermost: HeightArray  # [rows, columns] mm
    innermost: HeightArray  # [rows, columns] mm
    known: npt.NDArray[np.bool_]  # [rows, columns]: a face was within MARGIN_MM

    @classmethod
    def under(cls, poses: FloatArray, probe: Probe | None) -> Skin:  # [P, 4, 4] mm
        """The skin under the training views of a probe. Raises what `way_in` raises."""
        views = poses[:: max(1, math.ceil(len(poses) / _MOST_VIEWS))]
        down, known = way_in(views, probe)
        axes = _axes(-down, views[len(views) // 2, :3, 0])
        return cls._through(_face_points(views, known) @ axes.T, axes)

    @classmethod
    def _through(cls, points: FloatArray, axes: FloatArray) -> Skin:  # [N, 3] mm along the axes, [3, 3]
        low = points[:, :2].min(axis=0) - MARGIN_MM
        extent = points[:, :2].max(axis=0) + MARGIN_MM - low
        cell_mm = max(_LEAST_CELL_MM, float(extent.max()) / (_MOST_CELLS - 1))
        columns, rows = (math.ceil(side / cell_mm) + 1 for side in extent.tolist())
        column, row = np.rint((points[:, :2] - low) / cell_mm).astype(np.intp).T
        outermost = np.full((rows, columns), -np.inf, np.float32)
        innermost = np.full((rows, columns), np.inf, np.float32)
        np.maximum.at(outermost, (row, column), points[:, 2].astype(np.float32))
        np.minimum.at(innermost, (row, column), points[:, 2].astype(np.float32))
        met = np.isfinite(outermost)
        away, nearest = cv2.distanceTransformWithLabels(
            (~met).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE, labelType=cv2.DIST_LABEL_PIXEL
        )
        origin = np.array([*low, 0.0]) @ axes
        heights = [_filled(one, met, nearest.astype(np.intp)) for one in (outermost, innermost)]
        return cls(origin, axes, cell_mm, heights[0], heights[1], away * cell_mm <= MARGIN_MM)

    def gaps_mm(self, points: FloatArray, directions: FloatArray) -> FloatArray:  # [..., 3] both -> [...]
        """Distance from points to the skin at rest along unit directions, mm; less than 0 where it lies behind.

        Infinite where no skin is known, and along a direction that does not run into the body (LEAST_SLOPE).
        """
        return self._distances_mm(points, directions, self.outermost)

    def pressed_mm(self, points: FloatArray, directions: FloatArray) -> FloatArray:  # [..., 3] both -> [...]
        """How far points lie beyond the innermost training face along unit directions, mm, at least 0."""
        distances = self._distances_mm(points, directions, self.innermost)
        return np.where(np.isfinite(distances), np.maximum(-distances, 0.0), 0.0)

    def _distances_mm(self, points: FloatArray, directions: FloatArray, heights: HeightArray) -> FloatArray:
        places, ways = ((values @ self.axes.T).reshape(-1, 3).T for values in (points - self.origin, directions))
        x, y, height = np.ascontiguousarray(places)  # apart: steps along one array take a fraction of the time
        along_x, along_y, rise = np.ascontiguousarray(ways)
        fall = np.minimum(rise, -LEAST_SLOPE)
        along = np.zeros_like(x)
        rows, columns = heights.shape
        for _ in range(_STEPS):
            row = np.clip((y + along * along_y) / self.cell_mm, 0.0, rows - 1.001)  # beyond the cells, of the outermost
            column = np.clip((x + along * along_x) / self.cell_mm, 0.0, columns - 1.001)
            step = (height + along * rise - interpolated(heights, row, column)) / fall
            along -= step
            if np.abs(step).max(initial=0.0) < _MET_MM:
                break
        i, j = (np.rint(at / self.cell_mm).astype(np.intp) for at in (y + along * along_y, x + along * along_x))
        inside = (i >= 0) & (i < rows) & (j >= 0) & (j < columns) & (rise <= -LEAST_SLOPE)
        met = inside & self.known[np.where(inside, i, 0), np.where(inside, j, 0)]
        return np.where(met, along, np.inf).reshape(points.shape[:-1])


def way_in(poses: FloatArray, probe: Probe | None) -> tuple[FloatArray, Probe]:  # [P, 4, 4] mm -> [3]
    """The unit vector into the body, as training views look on the whole, and their probe.

    Raises InvalidArgument where there is no skin under them: no views or no probe are known, or they look all around,
    as in a vessel or about a limb.
    """
    if probe is None or not len(poses):
        raise InvalidArgument(
            "contact needs a scene that knows its training poses and their probe; this one does not", field="contact"
        )
    down: FloatArray = poses[:, :3, 2].mean(axis=0)
    if probe.lines.wrap or np.linalg.norm(down) < _LEAST_AGREEMENT:
        raise InvalidArgument(
            "contact needs a scene whose training views look into the body from one side; those of this one look all "
            "around",
            field="contact",
        )
    return down / np.linalg.norm(down), probe


def _axes(out: FloatArray, lateral: FloatArray) -> FloatArray:  # [3], [3] -> [3, 3]
    """Unit vectors: as near to lateral as can be, across it, and out of the body."""
    along = lateral - out * (lateral @ out)
    if np.linalg.norm(along) < 1e-6:  # a view that looks along the skin
        along = np.cross(out, np.eye(3)[np.argmin(np.abs(out))])
    along = along / np.linalg.norm(along)
    return np.stack([along, np.cross(out, along), out])


def _face_points(views: FloatArray, probe: Probe) -> FloatArray:  # [P, 4, 4] mm -> [P·K, 3] mm
    lines, depth = probe.lines, probe.face_depth_mm
    count = 2 + math.ceil(lines.breadth_mm(depth) / _LEAST_CELL_MM)
    origins, directions = lines.rays(lines.start + lines.span * np.linspace(0.0, 1.0, count))
    x, z = (origins + depth * directions).T
    face = np.stack([x, np.zeros_like(x), z], axis=-1)
    return (face @ views[:, :3, :3].transpose(0, 2, 1) + views[:, None, :3, 3]).reshape(-1, 3)


def _filled(heights: HeightArray, met: npt.NDArray[np.bool_], nearest: npt.NDArray[np.intp]) -> HeightArray:
    """With heights where no face was: those of the nearest one that was met, smoothed."""
    by_label = np.zeros(int(nearest.max()) + 1, np.float32)
    by_label[nearest[met]] = heights[met]
    filled: HeightArray = by_label[nearest]
    for _ in range(_SETTLED):
        filled = np.where(met, heights, cv2.blur(filled, (5, 5)))
    return filled


@dataclass(frozen=True, eq=False)
class Touch:
    """Where the W scan lines of C poses meet the skin. Made by `Touch.of`."""

    skin: Skin
    faces: FloatArray  # [C, W, 3] mm: where the lines leave the face
    directions: FloatArray  # [C, W, 3]

    @classmethod
    def of(cls, skin: Skin, probe: Probe, poses: FloatArray, width: int) -> Touch:  # [C, 4, 4] or [4, 4] mm
        exact = check_poses(poses)
        origins, directions = probe.scan_lines(width)
        turned = exact[:, :3, :3].transpose(0, 2, 1)
        faces = (origins + probe.face_depth_mm * directions) @ turned + exact[:, None, :3, 3]  # [C, W, 3]
        return cls(skin, faces, directions @ turned)

    @cached_property
    def gaps_mm(self) -> FloatArray:  # [C, W]
        """From the face to the skin at rest along the line; below 0: it is pressed, infinite: no skin is known."""
        return self.skin.gaps_mm(self.faces, self.directions)

    @cached_property
    def depths_mm(self) -> FloatArray:  # [C, W]
        """How far the face lies beyond the innermost training face; 0 for lines without contact."""
        return np.where(self.lines, self.skin.pressed_mm(self.faces, self.directions), 0.0)

    def mean(self, depths_mm: FloatArray) -> FloatArray:  # [C, W] -> [C]
        """Over the lines with contact; 0 where none has it."""
        mean: FloatArray = depths_mm.sum(axis=1) / np.maximum(self.lines.sum(axis=1), 1)
        return mean

    @property
    def lines(self) -> npt.NDArray[np.bool_]:  # [C, W]
        """The scan lines that have contact: their faces are not more than COUPLING_MM off the skin."""
        return self.gaps_mm <= COUPLING_MM

    @property
    def shares(self) -> FloatArray:  # [C]
        shares: FloatArray = self.lines.mean(axis=1)
        return shares
