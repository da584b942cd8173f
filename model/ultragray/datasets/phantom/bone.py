"""Lumbar vertebrae as a signed distance, mm, negative inside, before the small bends of `anatomy.straightened`.

One vertebra in its own frame: x lateral, y caudal, z depth, the origin on the skin over the middle of its level. It
repeats every 35 mm along y, as the lumbar spine does.
"""

from __future__ import annotations

import numpy as np

from ...probe import FloatArray

LEVEL_SPACING_MM = 35.0
TOP_MM = 12.0  # no bone above
BODY_DEPTH_MM = 54.5  # posterior wall of the vertebral bodies
BODY_HALF_WIDTH_MM = 19.0
BODY_HALF_LENGTH_MM = 13.0  # along the spine; discs fill the rest of a level
LAMINA_SLOPE = 0.33  # a lamina rises towards its caudal edge: the saw-tooth of paramedian views
BLEND_MM = 2.0  # radius with which the parts run into each other


def distance_mm(points: FloatArray) -> FloatArray:  # [N, 3] -> [N]
    """Signed distance to the nearest vertebra."""
    local = _local(points)
    half = (BODY_HALF_WIDTH_MM - 2.0, BODY_HALF_LENGTH_MM - 2.0, 13.0)
    body = _box(local, (0.0, 0.0, BODY_DEPTH_MM + 15.0), half, 2.0)
    return np.minimum(_posterior(local), body)


def posterior_distance_mm(points: FloatArray) -> FloatArray:  # [N, 3] -> [N]
    """Signed distance to what lies behind the canal: spinous process, laminae, articular and transverse processes."""
    return _posterior(_local(points))


def _local(points: FloatArray) -> FloatArray:  # [N, 3] -> [N, 3]
    """x without its side, y from the nearest level in [−17.5, 17.5) mm, z."""
    y = (points[:, 1] + LEVEL_SPACING_MM / 2) % LEVEL_SPACING_MM - LEVEL_SPACING_MM / 2
    return np.stack([np.abs(points[:, 0]), y, points[:, 2]], axis=1)


def _posterior(local: FloatArray) -> FloatArray:  # [N, 3] -> [N]
    x, y, z = local.T
    crest = _capsule(local, (0.0, -3.0, 17.6), (0.0, 10.0, 17.0), 3.5)
    blade = _box(local, (0.0, 3.5, 24.0), (0.6, 8.0, 9.0), 1.6)
    ramp = np.stack([x, y, z + LAMINA_SLOPE * y], axis=1)
    lamina = _extruded_along_y(ramp, (1.0, 31.4), (13.0, 36.4), 3.4, middle=1.0, half=7.5)
    pillar = _capsule(local, (16.0, -16.0, 39.5), (14.0, 13.5, 34.0), 4.0)
    transverse = _capsule(local, (14.0, -9.0, 41.0), (28.0, -11.0, 43.0), 3.6)
    joined = _blend(_blend(crest, blade), lamina)
    return _blend(_blend(joined, pillar), transverse)


def _capsule(p: FloatArray, start: tuple[float, ...], end: tuple[float, ...], radius: float) -> FloatArray:
    a, axis = np.asarray(start), np.asarray(end) - np.asarray(start)
    t = np.clip((p - a) @ axis / (axis @ axis), 0.0, 1.0)
    return _length(p - a - t[:, None] * axis) - radius


def _box(p: FloatArray, middle: tuple[float, ...], half: tuple[float, ...], radius: float) -> FloatArray:
    q: FloatArray = np.abs(p - np.asarray(middle)) - np.asarray(half)
    inside = np.minimum(np.maximum(np.maximum(q[:, 0], q[:, 1]), q[:, 2]), 0.0)
    return _length(np.maximum(q, 0.0)) + inside - radius


def _length(vectors: FloatArray) -> FloatArray:  # [N, 3] -> [N]
    length: FloatArray = np.sqrt(np.einsum("ni,ni->n", vectors, vectors))  # faster than np.linalg.norm
    return length


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
