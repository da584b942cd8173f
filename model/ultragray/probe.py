"""Probes: where each pixel lies in the probe frame.

Convention. Probe frame, right-handed: x lateral (image columns, left to right), y elevation, z axial (depth, image
rows). Origin: centre of the transducer face (linear), apex of the fan (convex), both (phased). Images are [H, W]: H
depth samples, W scan lines; sample i lies at depth near + (far − near)·(i+½)/H along its scan line, so the geometry in
mm does not depend on H.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, ClassVar, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from .errors import InvalidProbe

FloatArray: TypeAlias = npt.NDArray[np.float64]
_P = TypeVar("_P", bound="_Planes")
PictureSamples: TypeAlias = tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]  # [rows, columns] each

MAX_LENGTH_MM = 10_000.0


def _check_number(field: str, value: object, *, low: float, high: float, low_open: bool) -> float:
    bracket = "(" if low_open else "["
    expected = f"a finite number in {bracket}{low:g}, {high:g}]"
    if isinstance(value, bool) or not isinstance(value, (int, float, np.floating, np.integer)):
        raise InvalidProbe(f"{field} must be {expected}, got {value!r}", field=field)
    try:
        number = float(value)
    except OverflowError:  # an int of hundreds of digits
        number = math.inf
    if not math.isfinite(number) or number > high or number < low or (low_open and number == low):
        raise InvalidProbe(f"{field} must be {expected}, got {value!r}", field=field)
    return number


@dataclass(frozen=True)
class Picture:
    """Where the pixels [H, W] of a picture lie in the image plane of a probe.

    Columns are counted in mm along x (`column_unit` "mm") or, where each is a scan line of a fan, in degrees from its
    axis ("deg"); rows in mm along z, or in mm of range. `first` is the centre of pixel (0, 0), (column, row), `step`
    the way to the next one, negative where the picture is flipped.
    """

    height: int
    width: int
    column_unit: str
    first: tuple[float, float]
    step: tuple[float, float]

    def positions_mm(self) -> tuple[FloatArray, FloatArray]:  # [1, W], [H, 1]
        """Column and row of each pixel's centre, in the units of the picture."""
        columns = self.first[0] + self.step[0] * np.arange(self.width, dtype=np.float64)
        rows = self.first[1] + self.step[1] * np.arange(self.height, dtype=np.float64)
        return columns[None, :], rows[:, None]

    def flipped(self) -> Picture:
        """With left and right exchanged."""
        last = self.first[0] + (self.width - 1) * self.step[0]
        return replace(self, first=(last, self.first[1]), step=(-self.step[0], self.step[1]))


class _Planes:
    """What all probes share: near and far depth in mm, on rows of equal thickness."""

    near_mm: float
    far_mm: float

    def _check_planes(self) -> None:
        near = _check_number("near_mm", self.near_mm, low=0.0, high=MAX_LENGTH_MM, low_open=False)
        far = _check_number("far_mm", self.far_mm, low=0.0, high=MAX_LENGTH_MM, low_open=True)
        if far <= near:
            raise InvalidProbe(f"far_mm must be greater than near_mm ({near:g}), got {far:g}", field="far_mm")
        object.__setattr__(self, "near_mm", near)
        object.__setattr__(self, "far_mm", far)

    @property
    def scan_line_length_mm(self) -> float:
        return self.far_mm - self.near_mm

    def depths_mm(self, height: int) -> FloatArray:  # [H]
        """Depth of each row along its scan line, in mm."""
        return self.near_mm + self.scan_line_length_mm * (np.arange(height) + 0.5) / height

    def cull_far_mm(self, height: int) -> float:
        """Depth beyond which a Gaussian's mean is culled: the top edge of the last row (infinite for one row)."""
        if height == 1:
            return math.inf
        return self.near_mm + self.scan_line_length_mm * (height - 1) / height

    def cropped(self: _P, share: float) -> _P:
        """The same probe with scan lines that end after this share of their length."""
        far_mm = self.near_mm + share * self.scan_line_length_mm
        return replace(self, far_mm=far_mm)  # type: ignore[type-var]  # every subclass is a dataclass


def _picture_mm(across_mm: float, top_mm: float, down_mm: float, pixel_mm: float) -> Picture:
    """Square pixels over a box about the axis, from `top_mm` on."""
    columns, rows = (max(1, math.ceil(length / pixel_mm)) for length in (across_mm, down_mm))
    first = (1 - columns) * pixel_mm / 2, top_mm + pixel_mm / 2
    return Picture(rows, columns, "mm", first, (pixel_mm, pixel_mm))


@dataclass(frozen=True)
class LinearProbe(_Planes):
    """A linear array: parallel scan lines along +z, the face centred on the origin.

    Raises InvalidProbe unless 0 < width_mm, 0 <= near_mm < far_mm, all finite and at most 10 m.
    """

    width_mm: float
    near_mm: float
    far_mm: float

    kind: ClassVar[str] = "linear"

    def __post_init__(self) -> None:
        width = _check_number("width_mm", self.width_mm, low=0.0, high=MAX_LENGTH_MM, low_open=True)
        object.__setattr__(self, "width_mm", width)
        self._check_planes()

    def scan_lines(self, width: int) -> tuple[FloatArray, FloatArray]:  # [W, 3] mm, [W, 3]
        """Origin (mm) and unit direction of each scan line, in the probe frame."""
        origins = np.zeros((width, 3))
        origins[:, 0] = self.width_mm * ((np.arange(width) + 0.5) / width - 0.5)
        return origins, np.tile(np.array([0.0, 0.0, 1.0]), (width, 1))

    def corners_mm(self) -> FloatArray:  # [4, 3]
        """Corners of the image plane in the probe frame: both edges at near and far."""
        half = self.width_mm / 2
        return np.array([(x, 0.0, z) for z in (self.near_mm, self.far_mm) for x in (-half, half)])

    def frame_picture(self, height: int, width: int) -> Picture:
        """A frame [H, W] as it is."""
        column_mm, row_mm = self.width_mm / width, self.scan_line_length_mm / height
        first = (column_mm - self.width_mm) / 2, self.near_mm + row_mm / 2
        return Picture(height, width, "mm", first, (column_mm, row_mm))

    def picture(self, pixel_mm: float) -> Picture:
        """The picture of a frame with square pixels."""
        return _picture_mm(self.width_mm, self.near_mm, self.scan_line_length_mm, pixel_mm)

    def picture_samples(self, shape: tuple[int, ...], pixel_mm: float) -> PictureSamples:
        """Row and column of the nearest place in a frame of `shape`, and whether anything is there, by pixel."""
        height, width = shape
        x, z = self.picture(pixel_mm).positions_mm()
        i = np.broadcast_to((z - self.near_mm) / self.scan_line_length_mm * height - 0.5, (len(z), x.shape[1]))
        j = np.broadcast_to((x / self.width_mm + 0.5) * width - 0.5, i.shape)
        inside = (np.abs(x) <= self.width_mm / 2) & (z <= self.far_mm)
        return np.clip(i, 0, height - 1), np.clip(j, 0, width - 1), inside


class _Fan(_Planes):
    """What convex and phased arrays share: scan lines that fan out from an apex at the origin, at equal angles."""

    opening_angle_deg: float

    def _check_fan(self) -> None:
        angle = _check_number("opening_angle_deg", self.opening_angle_deg, low=0.0, high=175.0, low_open=True)
        object.__setattr__(self, "opening_angle_deg", angle)
        self._check_planes()

    def angles_rad(self, width: int) -> FloatArray:  # [W]
        """Angle of each scan line from the z axis, positive towards +x, in radians."""
        return math.radians(self.opening_angle_deg) * ((np.arange(width) + 0.5) / width - 0.5)

    def scan_lines(self, width: int) -> tuple[FloatArray, FloatArray]:  # [W, 3] mm, [W, 3]
        """Origin (mm) and unit direction of each scan line, in the probe frame."""
        theta = self.angles_rad(width)
        return np.zeros((width, 3)), np.stack([np.sin(theta), np.zeros(width), np.cos(theta)], axis=1)

    def corners_mm(self) -> FloatArray:  # [6, 3]
        """Corners of the fan in the probe frame: left edge, middle and right edge at near and far."""
        half = math.radians(self.opening_angle_deg) / 2
        return np.array(
            [(r * math.sin(t), 0.0, r * math.cos(t)) for r in (self.near_mm, self.far_mm) for t in (-half, 0.0, half)]
        )

    def scan_convert(self, frame: npt.NDArray[Any], pixel_mm: float) -> npt.NDArray[np.float32]:
        """A frame [H, W] of range and angle as a picture [rows, columns] in mm, `pixel_mm` square, 0 outside the fan.

        The picture spans the fan's bounding box; interpolation is bilinear.
        """
        height, width = frame.shape
        i, j, inside = self.picture_samples(frame.shape, pixel_mm)
        i0 = np.minimum(i.astype(np.intp), max(0, height - 2))
        j0 = np.minimum(j.astype(np.intp), max(0, width - 2))
        i1, j1 = np.minimum(i0 + 1, height - 1), np.minimum(j0 + 1, width - 1)
        fi, fj = i - i0, j - j0
        upper = frame[i0, j0] * (1 - fj) + frame[i0, j1] * fj
        lower = frame[i1, j0] * (1 - fj) + frame[i1, j1] * fj
        return np.where(inside, upper * (1 - fi) + lower * fi, 0.0).astype(np.float32)

    def scan_convert_labels(self, labels: npt.NDArray[np.uint8], pixel_mm: float) -> npt.NDArray[np.uint8]:
        """`scan_convert` for labels [H, W]: each pixel of the picture has that of the nearest sample."""
        i, j, inside = self.picture_samples(labels.shape, pixel_mm)
        picture: npt.NDArray[np.uint8] = np.where(
            inside, labels[np.rint(i).astype(np.intp), np.rint(j).astype(np.intp)], 0
        ).astype(np.uint8)
        return picture

    def frame_picture(self, height: int, width: int) -> Picture:
        """A frame [H, W] as it is: range × angle."""
        column_deg, row_mm = self.opening_angle_deg / width, self.scan_line_length_mm / height
        first = (column_deg - self.opening_angle_deg) / 2, self.near_mm + row_mm / 2
        return Picture(height, width, "deg", first, (column_deg, row_mm))

    def picture(self, pixel_mm: float) -> Picture:
        """The picture of the fan, over its bounding box, with square pixels."""
        half = math.radians(self.opening_angle_deg) / 2
        top_mm = self.near_mm * math.cos(half)
        return _picture_mm(2 * self.far_mm * math.sin(half), top_mm, self.far_mm - top_mm, pixel_mm)

    def picture_samples(self, shape: tuple[int, ...], pixel_mm: float) -> PictureSamples:
        """Row and column of the nearest place in a frame of `shape`, and whether the fan is there, by pixel."""
        height, width = shape
        half = math.radians(self.opening_angle_deg) / 2
        x, z = self.picture(pixel_mm).positions_mm()
        radius, theta = np.hypot(x, z), np.arctan2(x, z)
        i = (radius - self.near_mm) / self.scan_line_length_mm * height - 0.5
        j = (theta / (2 * half) + 0.5) * width - 0.5
        inside = (np.abs(theta) <= half) & (radius >= self.near_mm) & (radius <= self.far_mm)
        return np.clip(i, 0, height - 1), np.clip(j, 0, width - 1), inside


@dataclass(frozen=True)
class ConvexProbe(_Fan):
    """A curved array: scan lines fan out from the apex, `near_mm` is the radius of the face.

    `opening_angle_deg` is the full angle of the fan. Raises InvalidProbe unless it lies in (0, 175] and
    0 <= near_mm < far_mm.
    """

    opening_angle_deg: float
    near_mm: float
    far_mm: float

    kind: ClassVar[str] = "convex"

    def __post_init__(self) -> None:
        self._check_fan()


@dataclass(frozen=True)
class PhasedProbe(_Fan):
    """A phased array: scan lines fan out from the centre of the face; `near_mm` is 0.

    `opening_angle_deg` is the full angle of the fan. Raises InvalidProbe unless it lies in (0, 175] and 0 < far_mm.
    """

    opening_angle_deg: float
    far_mm: float
    near_mm: float = field(default=0.0, init=False, repr=False)

    kind: ClassVar[str] = "phased"

    def __post_init__(self) -> None:
        self._check_fan()


FanProbe: TypeAlias = ConvexProbe | PhasedProbe
Probe: TypeAlias = LinearProbe | FanProbe

_KINDS: dict[str, type[LinearProbe] | type[ConvexProbe] | type[PhasedProbe]] = {
    probe.kind: probe for probe in (LinearProbe, ConvexProbe, PhasedProbe)
}
_KIND_NAMES = '"linear", "convex" or "phased"'


def probe_to_dict(probe: Probe) -> dict[str, Any]:
    """The probe as a JSON object: `{"kind": "linear", "width_mm": …, "near_mm": …, "far_mm": …}`."""
    return {"kind": probe.kind, **{name: value for name, value in asdict(probe).items() if name in _given(type(probe))}}


def probe_from_dict(document: Mapping[str, Any]) -> Probe:
    """Inverse of `probe_to_dict`. Raises InvalidProbe for an unknown kind, a missing or a surplus key."""
    kind = document.get("kind") if isinstance(document, Mapping) else None
    if not isinstance(kind, str) or kind not in _KINDS:
        raise InvalidProbe(f"probe must be an object with kind {_KIND_NAMES}, got {document!r}", field="kind")
    cls = _KINDS[kind]
    expected = {"kind", *_given(cls)}
    if set(document) != expected:
        raise InvalidProbe(f"probe of kind {cls.kind} must have the keys {sorted(expected)}, got {sorted(document)}")
    return cls(**{key: value for key, value in document.items() if key != "kind"})


def _given(cls: type[LinearProbe] | type[ConvexProbe] | type[PhasedProbe]) -> list[str]:
    """The numbers that a probe of the class is made of."""
    return [one.name for one in fields(cls) if one.init]


def stretch_released_far(near: float, far_released: float, height: int) -> float:
    """The far plane of ours that puts H rows where the released code's grid (i+½)/(H−1) has them (same unit)."""
    if height < 2:
        raise InvalidProbe(f"the released depth grid needs at least 2 rows, got {height}", field="height")
    return near + (far_released - near) * height / (height - 1)
