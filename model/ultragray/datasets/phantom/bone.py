"""Lumbar vertebrae as a signed distance, mm, negative inside, before the small bends of `anatomy.straightened`.

One vertebra in its own frame: x lateral, y caudal, z depth, the origin on the skin over the middle of its level. It
repeats every 35 mm along y, as the lumbar spine does.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Floats: TypeAlias = npt.NDArray[np.floating[Any]]  # computed in the type that comes in: float32 is twice as fast
Place: TypeAlias = tuple[Floats, Floats | float, Floats]  # x, y, z, each [N]
Triple: TypeAlias = tuple[float, float, float]

LEVEL_SPACING_MM = 35.0
TOP_MM = 12.0  # no bone above
BODY_DEPTH_MM = 54.5  # posterior wall of the vertebral bodies
BODY_HALF_WIDTH_MM = 19.0
BODY_HALF_LENGTH_MM = 13.0  # along the spine; discs fill the rest of a level
LAMINA_SLOPE = 0.33  # a lamina rises towards its caudal edge: the saw-tooth of paramedian views
BLEND_MM = 2.0  # radius with which the parts run into each other


def distance_mm(points: Floats) -> Floats:  # [N, 3] -> [N]
    """Signed distance to the nearest vertebra."""
    local = _local(points)
    half = (BODY_HALF_WIDTH_MM - 2.0, BODY_HALF_LENGTH_MM - 2.0, 13.0)
    body = _box(local, (0.0, 0.0, BODY_DEPTH_MM + 15.0), half, 2.0)
    return np.minimum(_posterior(local), body)


def _local(points: Floats) -> Place:
    """x without its side, y from the nearest level in [−17.5, 17.5) mm, z."""
    x, y, z = points.T
    return np.abs(x), (y + LEVEL_SPACING_MM / 2) % LEVEL_SPACING_MM - LEVEL_SPACING_MM / 2, z


def _posterior(local: Place) -> Floats:
    """The bone behind the canal: spinous process, laminae, articular and transverse processes."""
    x, y, z = local
    crest = _capsule(local, (0.0, -3.0, 17.6), (0.0, 10.0, 17.0), 3.5)
    blade = _box(local, (0.0, 3.5, 24.0), (0.6, 8.0, 9.0), 1.6)
    across = _capsule((x, 0.0, z + LAMINA_SLOPE * y), (1.0, 0.0, 31.4), (13.0, 0.0, 36.4), 0.0)
    lamina = np.hypot(across, np.maximum(np.abs(y - 1.0) - 7.5, 0.0)) - 3.4  # that bar, drawn out along y
    pillar = _capsule(local, (16.0, -16.0, 39.5), (14.0, 13.5, 34.0), 4.0)
    transverse = _capsule(local, (14.0, -9.0, 41.0), (28.0, -11.0, 43.0), 3.6)
    joined = _blend(_blend(crest, blade), lamina)
    return _blend(_blend(joined, pillar), transverse)


def _capsule(place: Place, start: Triple, end: Triple, radius: float) -> Floats:
    (x, y, z), (a, b, c) = place, start
    u, v, w = end[0] - a, end[1] - b, end[2] - c
    t = np.clip(((x - a) * u + (y - b) * v + (z - c) * w) / (u * u + v * v + w * w), 0.0, 1.0)
    return _length(x - a - t * u, y - b - t * v, z - c - t * w) - radius


def _box(place: Place, middle: Triple, half: Triple, radius: float) -> Floats:
    x, y, z = (np.abs(at - m) - h for at, m, h in zip(place, middle, half, strict=True))
    inside = np.minimum(np.maximum(np.maximum(x, y), z), 0.0)
    return _length(np.maximum(x, 0.0), np.maximum(y, 0.0), np.maximum(z, 0.0)) + inside - radius


def _length(x: Floats, y: Floats, z: Floats) -> Floats:
    return np.sqrt(x * x + y * y + z * z)


def _blend(a: Floats, b: Floats) -> Floats:
    """The union of two solids, its edges rounded."""
    overlap = np.maximum(BLEND_MM - np.abs(a - b), 0.0)
    return np.minimum(a, b) - overlap * overlap / (4.0 * BLEND_MM)
