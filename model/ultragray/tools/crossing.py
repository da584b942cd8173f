"""Where scan lines meet a tool: what its echo and its shadow follow from, whatever its shape."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ultragray.probe import FloatArray, Probe

LEAST_SLICE_SIGMA_MM = 0.1  # of the slice that tools are seen in, where the frames show a thinner one
_LEAST_SPACING_MM = 1e-6


@dataclass(frozen=True, eq=False)
class ScanView:
    """The W scan lines of a probe at C poses, and the slice that they see."""

    probe: Probe
    poses: FloatArray  # [C, 4, 4] mm, probe→scene
    width: int
    slice_sigma_mm: tuple[float, float, float] = (0.0, 0.0, np.inf)  # at the focus; depth of the focus; Rayleigh range

    @cached_property
    def lines(self) -> tuple[FloatArray, FloatArray, FloatArray]:  # [W, 3] mm, [W, 3], [W, 3]
        """Origin of each line, its direction, and the direction across it in the image plane, in the probe frame."""
        origins, along = self.probe.scan_lines(self.width)
        return origins, along, np.stack([along[:, 2], along[:, 1], -along[:, 0]], axis=-1)

    def spacing_mm(self, depth_mm: FloatArray) -> FloatArray:  # [...] -> [...]
        """Distance of neighbouring lines, across them, by depth; above 0."""
        return np.maximum(self._apart_mm + self.turn * depth_mm, _LEAST_SPACING_MM)

    @cached_property
    def turn(self) -> float:
        """The angle between neighbouring lines, radians: by as much their distance grows with depth."""
        _, along = self._neighbours
        return float(np.arccos(np.clip(along[0] @ along[1], -1.0, 1.0)))

    @cached_property
    def _apart_mm(self) -> float:
        """Distance of neighbouring lines at depth 0."""
        origins, along = self._neighbours
        return abs(float((origins[1] - origins[0]) @ (along[0, 1], -along[0, 0])))

    @cached_property
    def _neighbours(self) -> tuple[FloatArray, FloatArray]:  # [2, 2] (x, z) both
        """Origins and directions of two lines in the middle that are as far apart as neighbours."""
        lines = self.probe.lines
        return lines.rays(lines.start + lines.span * (0.5 + np.array([-0.5, 0.5]) / self.width))

    def slice_mm(self, depth_mm: FloatArray) -> FloatArray:  # [...] -> [...]
        """Standard deviation of the slice along elevation, by depth."""
        at_focus, focus, rayleigh = self.slice_sigma_mm
        return np.maximum(at_focus * np.hypot(1.0, (depth_mm - focus) / rayleigh), LEAST_SLICE_SIGMA_MM)

    def in_probe_frame(self, points: FloatArray) -> FloatArray:  # [N, 3] mm -> [C, N, 3] mm
        """Points of the scene frame as each pose sees them."""
        rotations, positions = self.poses[:, :3, :3], self.poses[:, :3, 3]
        seen: FloatArray = (points - positions[:, None]) @ rotations
        return seen


@dataclass(frozen=True, eq=False)
class Crossing:
    """Scan lines that meet a tool: all [K, C, W], K layers of the slice, whose effects are added up."""

    cover: FloatArray  # share of the line's width and of the slice that meets the tool, 0 to 1
    first_mm: FloatArray  # depths between which the side that is met first lies
    last_mm: FloatArray
    filled_mm: FloatArray  # length of the line behind it that shows the tool's inside, not tissue
    own_first_mm: FloatArray  # depths between which pixels have the tool's label
    own_last_mm: FloatArray
    path_mm: FloatArray  # length of the way through the tool, above 0
    slant: FloatArray  # sine of the angle between the line and the normal of the side: 0 head on, 1 along it
    stopped: FloatArray  # share of the beam that the tool stops


def covered(gap_mm: FloatArray, half_mm: float | FloatArray, spacing_mm: FloatArray) -> FloatArray:
    """The share of a scan line as wide as the spacing that lies within half_mm of a middle that is gap_mm away."""
    return np.clip((half_mm - gap_mm) / spacing_mm + 0.5, 0.0, 1.0)


def dot(vectors: FloatArray, others: FloatArray) -> FloatArray:  # [..., 3] both -> [...]
    """Scalar products."""
    product: FloatArray = (vectors * others).sum(axis=-1)
    return product
