"""Lumbar vertebrae: cortical bone that reflects like a mirror and lets nothing through.

One vertebra is a signed distance (mm, negative inside) in its own frame: x lateral, y caudal, z depth, the
origin on the skin over the middle of its level. It repeats every 35 mm along y, as the lumbar spine does.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..probe import FloatArray
from .splats import Splats, normalised, scattered

LEVEL_SPACING_MM = 35.0
BODY_DEPTH_MM = 54.0  # posterior wall of the vertebral bodies
LAMINA_SLOPE = 0.33  # a lamina rises towards its caudal edge: the saw-tooth of paramedian views
DEPTHS_MM = (12.0, 48.0)  # of the posterior parts
BLEND_MM = 2.0  # radius with which the parts run into each other


def distance_mm(points: FloatArray) -> FloatArray:  # [N, 3] -> [N]
    """Signed distance to the nearest vertebra's posterior parts."""
    x, z = np.abs(points[:, 0]), points[:, 2]
    y = _local_y(points[:, 1])
    local = np.stack([x, y, z], axis=1)
    crest = _capsule(local, (0.0, -3.0, 17.6), (0.0, 10.0, 17.0), 3.5)
    blade = _box(local, (0.0, 3.5, 24.0), (0.6, 8.0, 9.0), 1.6)
    ramp = np.stack([x, y, z + LAMINA_SLOPE * y], axis=1)
    lamina = _extruded_along_y(ramp, (1.0, 31.4), (13.0, 36.4), 3.4, middle=1.0, half=7.5)
    pillar = _capsule(local, (16.0, -16.0, 39.5), (14.0, 13.5, 34.0), 4.0)
    transverse = _capsule(local, (14.0, -9.0, 41.0), (28.0, -11.0, 43.0), 3.6)
    joined = _blend(_blend(crest, blade), lamina)
    return _blend(_blend(joined, pillar), transverse)


def _local_y(y: FloatArray) -> FloatArray:
    """Position along the spine relative to the nearest level, in [−17.5, 17.5) mm."""
    return (y + LEVEL_SPACING_MM / 2) % LEVEL_SPACING_MM - LEVEL_SPACING_MM / 2


def _capsule(p: FloatArray, start: tuple[float, ...], end: tuple[float, ...], radius: float) -> FloatArray:
    a, axis = np.asarray(start), np.asarray(end) - np.asarray(start)
    t = np.clip((p - a) @ axis / (axis @ axis), 0.0, 1.0)
    distance: FloatArray = np.linalg.norm(p - a - t[:, None] * axis, axis=1)
    return distance - radius


def _box(p: FloatArray, middle: tuple[float, ...], half: tuple[float, ...], radius: float) -> FloatArray:
    q: FloatArray = np.abs(p - np.asarray(middle)) - np.asarray(half)
    distance: FloatArray = np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)
    return distance - radius


def _extruded_along_y(
    p: FloatArray,
    start: tuple[float, float],
    end: tuple[float, float],
    radius: float,
    *,
    middle: float,
    half: float,
) -> FloatArray:
    """A bar through two (x, z) points, drawn out along y."""
    section = np.stack([p[:, 0], np.zeros(len(p)), p[:, 2]], axis=1)
    across = _capsule(section, (start[0], 0.0, start[1]), (end[0], 0.0, end[1]), 0.0)
    return np.hypot(across, np.maximum(np.abs(p[:, 1] - middle) - half, 0.0)) - radius


def _blend(a: FloatArray, b: FloatArray) -> FloatArray:
    """The union of two solids, its edges rounded."""
    overlap = np.maximum(BLEND_MM - np.abs(a - b), 0.0)
    return np.minimum(a, b) - overlap * overlap / (4.0 * BLEND_MM)


def _gradient(points: FloatArray) -> FloatArray:  # [N, 3] unit, outwards
    step = 1e-3
    shifts = step * np.eye(3)
    return normalised(np.stack([distance_mm(points + s) - distance_mm(points - s) for s in shifts], axis=1))


def vertebrae(rng: np.random.Generator, low_y_mm: float, high_y_mm: float) -> Splats:
    """The bright face of the cortex, the dense bone behind it that absorbs, and the marrow."""
    low, high = (-34.0, low_y_mm, DEPTHS_MM[0]), (34.0, high_y_mm, DEPTHS_MM[1])
    points = scattered(rng, low, high, (1.0, 1.0, 1.0))
    distances = distance_mm(points)
    face, outward = _project(points[np.abs(distances) < 0.55])
    face = face + outward * rng.normal(0.0, 0.1, (len(face), 1))
    facing = rng.uniform(0.94, 0.99, len(face))
    marrow = points[distances < -2.2]
    return Splats.join(
        Splats.of(face, (0.75, 0.75, 0.42), facing=facing, edge_on=0.3, tau=0.9, normals=outward),
        Splats.of(face - 1.5 * outward, (1.1, 1.1, 0.6), facing=0.02, tau=0.01, normals=outward),
        Splats.of(marrow, (0.85, 0.85, 0.8), facing=0.02, tau=0.01),
    )


def _project(points: FloatArray) -> tuple[FloatArray, FloatArray]:  # [N, 3] -> [M, 3], [M, 3]
    """Points near the surface moved onto it, with outward normals; none on faces turned from the probe."""
    for _ in range(2):
        points = points - distance_mm(points)[:, None] * _gradient(points)
    outward = _gradient(points)
    seen = outward[:, 2] < 0.35
    return points[seen], outward[seen]


class Shadow:
    """The depth below which bone hides everything from a probe on the skin, over a grid of x and y."""

    STEP_MM = 1.0
    REACH = 3  # grid steps: a tilted beam comes in from the side, so bone must cover the surroundings too

    def __init__(self, half_width_mm: float, half_length_mm: float) -> None:
        self.low_mm = np.array([-half_width_mm, -half_length_mm])
        x = np.arange(-half_width_mm, half_width_mm + self.STEP_MM, self.STEP_MM)
        y = np.arange(-half_length_mm, half_length_mm + self.STEP_MM, self.STEP_MM)
        z = np.arange(*DEPTHS_MM, self.STEP_MM)
        grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
        solid = distance_mm(grid.reshape(-1, 3)).reshape(grid.shape[:3]) < 0.0
        depth = np.where(solid.any(axis=2), z[solid.argmax(axis=2)], np.inf)
        for axis in (0, 1):
            depth = np.max([np.roll(depth, k, axis) for k in range(-self.REACH, self.REACH + 1)], axis=0)
        self.depth_mm = depth

    def hides(self, points: FloatArray) -> npt.NDArray[np.bool_]:  # [N, 3] -> [N]
        cells = np.round((points[:, :2] - self.low_mm) / self.STEP_MM).astype(int)
        i, j = np.clip(cells, 0, np.array(self.depth_mm.shape) - 1).T
        return np.asarray(points[:, 2] > self.depth_mm[i, j])
