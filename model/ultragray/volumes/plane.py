"""Slices as callers ask for them: a plane through a scene, and the field that is sampled on it. Free of torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ultragray.contract import Contract, described
from ultragray.probe import FloatArray, Picture
from ultragray.settings import Encoding
from ultragray.volumes.grid import SMALLEST_SPACING_MM, VolumeGrid
from ultragray.volumes.names import VOLUME_FIELDS


@dataclass(frozen=True, kw_only=True)
class SliceSettings(Contract):
    """A slice through a scene, on any plane: no probe is involved. Raises InvalidArgument."""

    field: str = described("At each point. attenuation: per mm.", "echo", choices=VOLUME_FIELDS)
    origin_mm: tuple[float, float, float] = described("Corner of the first pixel, in the scene's frame.")
    right: tuple[float, float, float] = described("Direction of the rows, of any length.", (1.0, 0.0, 0.0))
    down: tuple[float, float, float] = described("Direction of the columns, at a right angle.", (0.0, 0.0, 1.0))
    size_mm: tuple[float, float] = described("Width and height.")
    spacing_mm: float = described("Distance of two pixels.", 0.5, low=SMALLEST_SPACING_MM, high=1000.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.grid()

    def grid(self) -> VolumeGrid:
        """Its pixels. Raises InvalidArgument, naming the field."""
        return VolumeGrid.on_plane(self.origin_mm, self.right, self.down, self.size_mm, self.spacing_mm)

    @property
    def numbers(self) -> Encoding:
        """The encoding that keeps its values: float32, of labels uint8."""
        return Encoding.UINT8 if self.field == "labels" else Encoding.FLOAT32

    def view(self, encoding: Encoding) -> SliceView:
        """The slice but for its place."""
        width, height, _ = self.grid().shape
        return SliceView(self.field, height, width, self.spacing_mm, encoding)

    def pose(self) -> FloatArray:  # [4, 4] mm
        """Its place: the centre of the first pixel, x along the rows and z along the columns."""
        return pose_of_grid(self.grid())


@dataclass(frozen=True)
class SliceView:
    """A slice but for its place, as `ultragray.settings.Resolved` is a frame but for its pose."""

    field: str
    height: int
    width: int
    spacing_mm: float
    encoding: Encoding

    @property
    def outputs(self) -> tuple[str, ...]:
        return (self.field,)

    @property
    def picture(self) -> Picture:
        """Size of the slice, and its pixels in the frame of its pose."""
        return Picture(self.height, self.width, "mm", (0.0, 0.0), (self.spacing_mm, self.spacing_mm))

    @property
    def view(self) -> tuple[Any, ...]:
        """All but the encoding: slices that agree in this can be sampled together."""
        return (self.field, self.height, self.width, self.spacing_mm)

    def grid(self, pose: FloatArray) -> VolumeGrid:  # [4, 4]
        """The pixels of a slice at a pose."""
        right, against_normal, down = pose[:3, :3].T
        axes = np.stack([right, down, -against_normal])
        return VolumeGrid(pose[:3, 3], axes, self.spacing_mm, (self.width, self.height, 1))


def pose_of_grid(grid: VolumeGrid) -> FloatArray:  # [4, 4] mm
    """The pose of a slice's pixels: x along its rows, z along its columns, y against its normal."""
    pose = np.eye(4)
    pose[:3, :3] = np.stack([grid.axes[0], -grid.axes[2], grid.axes[1]], axis=1)
    pose[:3, 3] = grid.origin_mm
    return pose
