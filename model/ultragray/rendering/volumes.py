"""Grids and planes in a scene, and the fields that it has there, in words: what volumes and slices are asked for by.
Free of torch.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray.contract import Contract, described
from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import MAX_POSITION_MM
from ultragray.geometry.probe import FloatArray, Picture
from ultragray.geometry.rotations import transforms_of
from ultragray.rendering.settings import Encoding
from ultragray.scene.info import SceneInfo

PIECE_PIXELS = 1 << 17  # of a slice, which is sampled in pieces between which frames go
CROWDED_PIECE_PIXELS = 1 << 15  # of one that others wait for
MOST_PIECES = 128
LESS_FOR_A_PIECE = 8  # so many times less than a frame may it cost

VOLUME_FIELDS = ("echo", "coverage", "attenuation", "labels")
VOLUME_SUFFIXES = (".nii.gz", ".nii", ".nrrd")
SLICE_SUFFIXES = (".png", ".npy")


def check_field(field: str, *, has_labels: bool) -> None:
    """Raises InvalidArgument for a field that is none of VOLUME_FIELDS, and for labels of a scene without them."""
    if field not in VOLUME_FIELDS:
        raise InvalidArgument(f"field must be one of {', '.join(VOLUME_FIELDS)}, got {field[:40]!r}", field="field")
    if field == "labels" and not has_labels:
        raise InvalidArgument("labels are for scenes whose Gaussians carry them, this one's carry none", field="field")


def numbers_of(field: str) -> Encoding:
    """The encoding that keeps the values of a slice: float32, of labels uint8."""
    return Encoding.UINT8 if field == "labels" else Encoding.FLOAT32


def as_grey(pixels: npt.NDArray[Any], field: str) -> npt.NDArray[Any]:  # [J, I] -> [J, I]
    """A slice as a picture shows it: white is 1, of attenuation its largest value; labels keep their numbers."""
    return pixels / pixels.max() if field == "attenuation" and pixels.any() else pixels


def voxel_bytes(field: str) -> int:
    """Bytes of a voxel: labels are uint8, the other fields float32."""
    return 1 if field == "labels" else 4


# VolumeGrid: where the voxels of a volume, or the pixels of a slice, lie in the scene's frame.
#
# Convention. Voxel (i, j, k) has its centre at origin_mm + spacing_mm · (i·axes[0] + j·axes[1] + k·axes[2]), in mm of
# the frame of the training sweep, the frame of every pose (docs/poses.md).

MAX_VOXELS = 1 << 28
MAX_SIDE = 32767  # NIfTI-1 counts voxels along an axis in 16 bits
SMALLEST_SPACING_MM = 1e-3
RIGHT_ANGLE_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class VolumeGrid:
    """A regular grid of points. Made by `over_box` or `on_plane`, which check what they are given."""

    origin_mm: FloatArray  # [3] centre of voxel (0, 0, 0)
    axes: FloatArray  # [3, 3] a unit vector a row, at right angles
    spacing_mm: float
    shape: tuple[int, int, int]  # voxels along each axis

    @classmethod
    def over_box(cls, low_mm: Sequence[float], high_mm: Sequence[float], spacing_mm: float) -> VolumeGrid:
        """Voxels that fill a box along the axes of the scene's frame, from its lower corner on.

        Raises InvalidArgument, naming `spacing_mm` or `box_mm`, for a box without extent and for too many voxels.
        """
        low, high = _lengths(low_mm, "box_mm"), _lengths(high_mm, "box_mm")
        _check_spacing(spacing_mm)
        if not (high > low).all():
            raise InvalidArgument(
                f"box_mm must extend along each axis, got {_words(low)} to {_words(high)}", field="box_mm"
            )
        shape = _counts(high - low, spacing_mm)
        return cls(low + spacing_mm / 2, np.eye(3), float(spacing_mm), (shape[0], shape[1], shape[2]))

    @classmethod
    def over_scene(cls, info: SceneInfo, box_mm: str | None, spacing_mm: float) -> VolumeGrid:
        """Voxels that fill a box (`parse_box`), without one the bounds of the scene's Gaussians.

        Raises what `parse_box` and `over_box` raise.
        """
        low, high = (info.bounds_min_mm, info.bounds_max_mm) if box_mm is None else parse_box(box_mm)
        return cls.over_box(low, high, spacing_mm)

    @classmethod
    def on_plane(
        cls,
        origin_mm: Sequence[float],
        right: Sequence[float],
        down: Sequence[float],
        size_mm: Sequence[float],
        spacing_mm: float,
    ) -> VolumeGrid:
        """The pixels of a slice: the first one's edge is at `origin_mm`, columns go along `right`, rows along `down`.

        The directions may have any length and must be at a right angle. `size_mm`: width and height. Raises
        InvalidArgument, naming the argument.
        """
        origin = _lengths(origin_mm, "origin_mm")
        axes = np.stack([_direction(right, "right"), _direction(down, "down")])
        if abs(float(axes[0] @ axes[1])) > RIGHT_ANGLE_TOLERANCE:
            angle = math.degrees(math.acos(float(np.clip(axes[0] @ axes[1], -1, 1))))
            raise InvalidArgument(f"down must be at a right angle to right, the angle is {angle:.2f}°", field="down")
        axes[1] -= (axes[0] @ axes[1]) * axes[0]
        axes[1] /= np.linalg.norm(axes[1])
        size = _lengths(size_mm, "size_mm", 2)
        _check_spacing(spacing_mm)
        if not (size > 0).all():
            raise InvalidArgument(f"size_mm must be a width and a height above 0, got {_words(size)}", field="size_mm")
        columns, rows = _counts(size, spacing_mm)
        first = origin + spacing_mm / 2 * (axes[0] + axes[1])
        return cls(first, np.stack([*axes, np.cross(*axes)]), float(spacing_mm), (columns, rows, 1))

    @property
    def pose(self) -> FloatArray:  # [4, 4] mm
        """Of its first layer: the centre of the first pixel, x along rows, z along columns, y against the normal."""
        return transforms_of(np.stack([self.axes[0], -self.axes[2], self.axes[1]], axis=1), self.origin_mm)

    @property
    def affine(self) -> FloatArray:  # [4, 4]
        """From voxel (i, j, k, 1) to mm in the scene's frame."""
        return transforms_of(self.axes.T * self.spacing_mm, self.origin_mm)


def parse_numbers(text: str, count: int, field: str) -> tuple[float, ...]:
    """`"1,2.5,-3"`: that many finite numbers. Raises InvalidArgument."""
    try:
        numbers = tuple(float(word) for word in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise InvalidArgument(
            f"{field} must be {count} finite numbers with commas between, got {text[:80]!r}", field=field
        )
    return numbers


def parse_box(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """`"-20:20,0:30,-5:45"`: the ranges of x, y and z as lower and upper corner. Raises InvalidArgument."""
    ranges = [re.fullmatch(r"\s*([^:]+):([^:]+)\s*", part) for part in text.split(",")]
    try:
        corners = [(float(one[1]), float(one[2])) for one in ranges if one]
    except ValueError:
        corners = []
    if len(corners) != 3 or len(ranges) != 3:
        raise InvalidArgument(
            f"box_mm must be ranges of x, y and z such as -20:20,0:30,-5:45, got {text[:80]!r}", field="box_mm"
        )
    return tuple(low for low, _ in corners), tuple(high for _, high in corners)


def _vector(values: Sequence[float], field: str, count: int = 3, most: float = math.inf) -> FloatArray:
    vector = np.asarray(values, np.float64)
    if vector.shape != (count,) or not np.isfinite(vector).all():
        raise InvalidArgument(f"{field} must hold {count} finite numbers, got {values}", field=field)
    if (np.abs(vector) > most).any():
        raise InvalidArgument(f"{field} must be at most {most:g} mm, got {_words(vector)}", field=field)
    return vector


_lengths = partial(_vector, most=MAX_POSITION_MM)


def _direction(values: Sequence[float], field: str) -> FloatArray:
    vector = _vector(values, field)
    largest = float(np.abs(vector).max())
    if largest == 0.0:
        raise InvalidArgument(f"{field} must be a direction, got {_words(vector)}", field=field)
    vector = vector / largest  # of which the square is a number
    return vector / np.linalg.norm(vector)


def _check_spacing(spacing_mm: float) -> None:
    if not SMALLEST_SPACING_MM <= spacing_mm <= MAX_POSITION_MM:
        raise InvalidArgument(
            f"spacing_mm must be {SMALLEST_SPACING_MM:g} to {MAX_POSITION_MM:g} mm, got {spacing_mm:g}",
            field="spacing_mm",
        )


def _counts(extent_mm: FloatArray, spacing_mm: float) -> list[int]:
    """Voxels along each axis. Raises InvalidArgument, saying which spacing would do, where they are too many."""
    counts = [max(1, math.ceil(float(extent) / spacing_mm - 1e-9)) for extent in extent_mm]
    voxels = math.prod(counts)
    if voxels > MAX_VOXELS or max(counts) > MAX_SIDE:
        enough = spacing_mm * max((voxels / MAX_VOXELS) ** (1 / len(counts)), max(counts) / MAX_SIDE)
        raise InvalidArgument(
            f"spacing_mm {spacing_mm:g} gives {' x '.join(map(str, counts))} voxels, the limit is {MAX_VOXELS:,} and "
            f"{MAX_SIDE:,} along an axis: take about {enough * 1.02:.3g} mm, or a smaller box",
            field="spacing_mm",
        )
    return counts


def _words(vector: FloatArray) -> str:
    return "(" + ", ".join(f"{value:g}" for value in vector) + ")"


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
        return VolumeGrid.on_plane(self.origin_mm, self.right, self.down, self.size_mm, self.spacing_mm)

    @property
    def numbers(self) -> Encoding:
        return numbers_of(self.field)

    def view(self, encoding: Encoding) -> SliceView:
        width, height, _ = self.grid().shape
        return SliceView(self.field, height, width, self.spacing_mm, encoding)

    def pose(self) -> FloatArray:  # [4, 4] mm
        """Its place: the centre of the first pixel, x along its rows, z along its columns, y against its normal."""
        return self.grid().pose


@dataclass(frozen=True)
class SliceView:
    """A slice but for its place, as `ultragray.rendering.settings.Resolved` is a frame but for its pose."""

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
        right, against_normal, down = pose[:3, :3].T
        axes = np.stack([right, down, -against_normal])
        return VolumeGrid(pose[:3, 3], axes, self.spacing_mm, (self.width, self.height, 1))
