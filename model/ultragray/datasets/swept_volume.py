"""The share of the space around a sweep that its image planes cross."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ultragray.datasets.sweep import Sweep
from ultragray.probe import FloatArray, Probe

VOXEL_MM = 1.0
MAX_VOXELS = 8_000_000
GROWTH = 1.01  # of voxels that are still too many
MAX_POINTS = 200_000  # of one image plane


@dataclass(frozen=True)
class SweptVolume:
    """Voxels crossed by any image plane, in the box around all planes along the axes of the middle frame."""

    swept_ml: float
    coverage: float  # crossed voxels / voxels of the box
    voxel_mm: float


def swept_volume(sweep: Sweep) -> SweptVolume:
    """Counts the voxels of 1 mm (more for volumes over eight litres) that image planes of the sweep cross."""
    axes = sweep.poses[len(sweep) // 2, :3, :3]
    corners = sweep.corners_mm() @ axes
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    voxel_mm = max(VOXEL_MM, float(np.prod(np.maximum(high - low, VOXEL_MM)) / MAX_VOXELS) ** (1 / 3))
    while _counts(high - low, voxel_mm).prod() > MAX_VOXELS:  # a side thinner than a voxel still takes one
        voxel_mm *= GROWTH
    counts = _counts(high - low, voxel_mm).astype(np.int64)
    crossed = np.zeros(counts.prod(), bool)
    points = _plane_points(sweep.probe, voxel_mm / 2)
    for pose in sweep.poses:
        places = ((points @ pose[:3, :3].T + pose[:3, 3]) @ axes - low) / voxel_mm
        x, y, z = np.clip(places.astype(np.int64), 0, counts - 1).T
        crossed[(x * counts[1] + y) * counts[2] + z] = True
    share = float(crossed.mean())
    return SweptVolume(swept_ml=float(crossed.sum()) * voxel_mm**3 / 1000.0, coverage=share, voxel_mm=voxel_mm)


def _counts(span_mm: FloatArray, voxel_mm: float) -> FloatArray:  # [3]
    return np.maximum(np.ceil(span_mm / voxel_mm - 1e-9), 1.0)


def _plane_points(probe: Probe, spacing_mm: float) -> FloatArray:  # [P, 3]
    """Points on the image plane, at most `spacing_mm` apart where their number allows."""
    sides_mm = probe.lines.breadth_mm(probe.far_mm), probe.scan_line_length_mm
    lines, samples = (max(2, math.ceil(side_mm / spacing_mm)) for side_mm in sides_mm)
    thinning = max(1.0, math.sqrt(lines * samples / MAX_POINTS))
    lines, samples = math.ceil(lines / thinning), math.ceil(samples / thinning)
    origins, directions = probe.scan_lines(lines)
    points: FloatArray = origins[:, None] + probe.depths_mm(samples)[None, :, None] * directions[:, None]
    return points.reshape(-1, 3)
