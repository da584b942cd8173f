"""Bundles of scan lines in an image plane: where they run, and which of them goes through a point.

The place of a line is its `across`, a number that grows evenly from line to line, in mm or degrees: of W lines, line j
has start + span·(j+½)/W. A point of the plane has x and z, lateral and axial, or its depth along the line through it
and the across of that line.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]


class Box(NamedTuple):
    """The smallest rectangle of the image plane that holds an image."""

    left: float  # x
    right: float
    top: float  # z
    bottom: float

    @property
    def longer_side(self) -> float:
        return max(self.right - self.left, self.bottom - self.top)


class ScanLines(ABC):
    """The base of the bundles. Lengths are in mm."""

    span: float  # from the left edge of the first line to the right edge of the last one, in `unit`
    unit: ClassVar[str]  # of `across`: "mm" or "deg"
    corner_shares: ClassVar[tuple[float, ...]]  # of the span: the lines at which corners of the image are taken
    wrap: ClassVar[bool] = False  # whether the first line follows the last

    @property
    def start(self) -> float:
        """The across of the left edge of the first line; the bundle lies about z."""
        return -self.span / 2

    def across(self, width: int) -> FloatArray:  # [W]
        """The across of each of W lines."""
        return self.start + self.span * ((np.arange(width) + 0.5) / width)

    @abstractmethod
    def rays(self, across: FloatArray) -> tuple[FloatArray, FloatArray]:  # [...] -> [..., 2] both
        """Origins of the lines, at depth 0, and their unit directions: x and z of each."""

    @abstractmethod
    def coordinates(self, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Depth and across of points; a depth of NaN where no line of the bundle, however wide, comes by."""

    @abstractmethod
    def beside(self, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distance of points from the outermost lines, 0 or less between them, and their depth."""

    @abstractmethod
    def box(self, near_mm: float, far_mm: float) -> Box:
        """Around the lines from one depth to another."""

    @abstractmethod
    def breadth_mm(self, depth_mm: float) -> float:
        """Length of a row of the image at a depth."""

    @property
    def are_upright(self) -> bool:
        """Whether all lines run along z: a frame is then a picture that is true to scale."""
        return False


@dataclass(frozen=True)
class ParallelLines(ScanLines):
    """Lines side by side from a straight face on the x axis, `span` wide; `across` is the x at which a line leaves it.

    All are turned by `steering_deg` from z towards +x.
    """

    span: float
    steering_deg: float = 0.0

    unit: ClassVar[str] = "mm"
    corner_shares: ClassVar[tuple[float, ...]] = (0.0, 1.0)

    @property
    def direction(self) -> tuple[float, float]:
        """Of every line: x and z."""
        steering = math.radians(self.steering_deg)
        return math.sin(steering), math.cos(steering)

    def rays(self, across: FloatArray) -> tuple[FloatArray, FloatArray]:
        origins = np.stack([across, np.zeros_like(across)], axis=-1)
        return origins, np.broadcast_to(self.direction, origins.shape).copy()

    def coordinates(self, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        along_x, along_z = self.direction
        return z / along_z, x - z * (along_x / along_z)

    def beside(self, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        depth, across = self.coordinates(x, z)
        return (np.abs(across) - self.span / 2) * self.direction[1], depth

    def box(self, near_mm: float, far_mm: float) -> Box:
        along_x, along_z = self.direction
        shifts = (near_mm * along_x, far_mm * along_x)
        return Box(min(shifts) - self.span / 2, max(shifts) + self.span / 2, near_mm * along_z, far_mm * along_z)

    def breadth_mm(self, depth_mm: float) -> float:
        return self.span

    @property
    def are_upright(self) -> bool:
        return self.steering_deg == 0.0


class _Angular(ScanLines):
    """Lines at even angles from a point at the origin; `across` is the angle from z towards +x."""

    unit: ClassVar[str] = "deg"

    def rays(self, across: FloatArray) -> tuple[FloatArray, FloatArray]:
        angle = np.radians(across)
        directions = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
        return np.zeros_like(directions), directions

    def breadth_mm(self, depth_mm: float) -> float:
        return depth_mm * math.radians(self.span)


@dataclass(frozen=True)
class FannedLines(_Angular):
    """A fan about z, `span` degrees wide, less than 180."""

    span: float

    corner_shares: ClassVar[tuple[float, ...]] = (0.0, 0.5, 1.0)

    def coordinates(self, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.where(z > 0, np.hypot(x, z), np.nan), np.degrees(np.arctan2(x, z))

    def beside(self, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        half = math.radians(self.span / 2)
        return np.abs(x) * math.cos(half) - z * math.sin(half), np.sqrt(x * x + z * z)

    def box(self, near_mm: float, far_mm: float) -> Box:
        half = math.radians(self.span / 2)
        side = far_mm * math.sin(half)
        return Box(-side, side, near_mm * math.cos(half), far_mm)


@dataclass(frozen=True)
class RadialLines(_Angular):
    """Lines all the way round, the left edge of the first one along z."""

    span = 360.0
    start = 0.0
    corner_shares: ClassVar[tuple[float, ...]] = (0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875)
    wrap: ClassVar[bool] = True

    def coordinates(self, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.hypot(x, z), np.degrees(np.arctan2(x, z)) % self.span

    def beside(self, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        depth = np.sqrt(x * x + z * z)
        return np.zeros_like(depth), depth

    def box(self, near_mm: float, far_mm: float) -> Box:
        return Box(-far_mm, far_mm, -far_mm, far_mm)


Lines: TypeAlias = ParallelLines | FannedLines | RadialLines
