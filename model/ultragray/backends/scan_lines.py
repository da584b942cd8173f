"""Scan lines as the fast kernels take them, in cm and radians."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ultragray.probe import FloatArray, Probe
from ultragray.probe.scan_lines import FannedLines, ParallelLines, RadialLines


class KernelLines(NamedTuple):
    """A bundle of lines that run side by side along z, or fan out from the origin.

    Line j of W is at start + span·(j+½)/W, in cm along x or in radians from z towards +x. Lines that are parallel but
    not upright become so in a sheared plane: with x' = x − z·tan φ and z' = z/cos φ, a line is x' = const and z' the
    depth along it. How a Gaussian's weight falls along a line does not depend on the axes of the plane, so kernels need
    no more than its mean and covariance in sheared ones: `axes` takes the lateral, elevation and axial axis of a pose
    to those (docs/physics.md §3).
    """

    fanned: bool
    wrap: bool  # whether the first line follows the last, a full turn later
    start: float
    span: float
    axes: FloatArray  # [3, 3]

    @classmethod
    def of(cls, probe: Probe) -> KernelLines:
        """The lines of a probe."""
        match probe.lines:
            case ParallelLines() as lines:
                along_x, along_z = lines.direction
                axes = np.eye(3)
                axes[2] = -along_x / along_z, 0.0, 1.0 / along_z
                return cls(False, False, lines.start / 10.0, lines.span / 10.0, axes)
            case FannedLines() | RadialLines() as lines:
                return cls(True, lines.wrap, math.radians(lines.start), math.radians(lines.span), np.eye(3))

    def view_axes(self, poses: FloatArray) -> FloatArray:  # [C, 4, 4] -> [C, 4, 4]
        """Poses whose axes are those of the sheared plane."""
        sheared = poses.copy()
        sheared[:, :3, :3] = poses[:, :3, :3] @ self.axes
        return sheared
