"""The base of all probes: what follows from a bundle of scan lines, a near and a far depth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt

from ultragray.contract import Family, annotated_fields, described
from ultragray.errors import InvalidProbe
from ultragray.probe.picture import Picture
from ultragray.probe.scan_lines import Box, FloatArray, Lines

_P = TypeVar("_P", bound="Probe")
BoolArray = npt.NDArray[np.bool_]

MAX_LENGTH_MM = 10_000.0
_UNITS = {"mm": " mm", "deg": "°"}


def length_field(meaning: str, **options: Any) -> Any:
    """A field for a length in mm: from 0, at most 10 m."""
    return described(meaning, high=MAX_LENGTH_MM, **(options if "above" in options else {"low": 0.0, **options}))


class Probe(Family):
    """A probe is its scan lines. A kind is a class: numbers, and the bundle of lines that they mean.

    Raises InvalidProbe for numbers beyond their limits, and unless near_mm < far_mm.
    """

    error: ClassVar[type[InvalidProbe]] = InvalidProbe
    usual_scan_lines_mm: ClassVar[tuple[float, float]] = (10.0, 400.0)  # their length
    kind: str
    near_mm: float  # depth at which the image begins
    far_mm: float  # and ends

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.far_mm <= self.near_mm:
            raise InvalidProbe(
                f"far_mm must be greater than near_mm ({self.near_mm:g}), got {self.far_mm:g}", field="far_mm"
            )

    def __str__(self) -> str:
        """In words, for messages: `linear probe (width 60 mm, near 0 mm, far 60 mm)`."""
        numbers = []
        for name in (item.name for item, _ in annotated_fields(type(self)) if item.name != "kind"):
            what, _, unit = name.replace("_", " ").rpartition(" ")
            numbers.append(f"{what} {getattr(self, name):g}{_UNITS[unit]}")
        return f"{self.kind} probe ({', '.join(numbers)})"

    @property
    def lines(self) -> Lines:
        """The bundle of scan lines."""
        raise NotImplementedError

    @property
    def face_depth_mm(self) -> float:
        """Depth of the face, from which depths are counted on a scanner."""
        raise NotImplementedError

    @property
    def pivot_depth_mm(self) -> float:
        """Depth of the middle of the face, about which a probe is tilted."""
        return self.face_depth_mm

    @property
    def scan_line_length_mm(self) -> float:
        return self.far_mm - self.near_mm

    @property
    def box_mm(self) -> Box:
        """The smallest rectangle of the image plane that holds the image."""
        return self.lines.box(self.near_mm, self.far_mm)

    @property
    def is_true_to_scale(self) -> bool:
        """Whether a frame, as it is, shows each mm equally long along a row, and along a column."""
        return self.lines.are_upright

    def depths_mm(self, height: int) -> FloatArray:  # [H]
        """Depth of each row along its scan line, in mm."""
        return self.near_mm + self.scan_line_length_mm * (np.arange(height) + 0.5) / height

    def cull_far_mm(self, height: int) -> float:
        """Depth beyond which a Gaussian's mean is culled: the top edge of the last row (infinite for one row)."""
        if height == 1:
            return math.inf
        return self.near_mm + self.scan_line_length_mm * (height - 1) / height

    def cull(self, x_mm: FloatArray, z_mm: FloatArray, height: int) -> BoolArray:  # [N] each
        """A mask of the means of Gaussians that count, by their depth: up to the top edge of the last row."""
        depth, _ = self.lines.coordinates(x_mm, z_mm)
        seen: BoolArray = (depth >= self.near_mm) & (depth <= self.cull_far_mm(height))
        return seen

    def scan_lines(self, width: int) -> tuple[FloatArray, FloatArray]:  # [W, 3] mm, [W, 3]
        """The point of depth 0 of each scan line (mm), and its unit direction, in the probe frame."""
        origins, directions = self.lines.rays(self.lines.across(width))
        return _in_probe_frame(origins), _in_probe_frame(directions)

    def points_mm(self, rows: FloatArray, columns: FloatArray) -> FloatArray:  # [...] both -> [..., 3]
        """Image coordinates, from 0 to 1 down and across the image, as points in the probe frame, mm."""
        origins, directions = self.lines.rays(self.lines.start + self.lines.span * columns)
        depth = self.near_mm + self.scan_line_length_mm * rows
        return _in_probe_frame(origins + depth[..., None] * directions)

    def image_coordinates(self, x_mm: FloatArray, z_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Inverse of `points_mm`: row and column of points of the image plane, NaN outside it; x and z broadcast."""
        depth, across = self.lines.coordinates(x_mm, z_mm)
        row = (depth - self.near_mm) / self.scan_line_length_mm
        column = (across - self.lines.start) / self.lines.span
        inside = (row >= 0.0) & (row <= 1.0) & (column >= 0.0) & (column <= 1.0)
        return np.where(inside, row, np.nan), np.where(inside, column, np.nan)

    def corners_mm(self) -> FloatArray:  # [2·K, 3]
        """Points of the outline in the probe frame: K along the near edge, left to right, then K along the far one."""
        columns = np.array(self.lines.corner_shares)
        return np.concatenate([self.points_mm(np.full(columns.shape, row), columns) for row in (0.0, 1.0)])

    def cropped(self: _P, share: float) -> _P:
        """The same probe with scan lines that end after this share of their length."""
        return self.ending_at(self.near_mm + share * self.scan_line_length_mm)

    def ending_at(self: _P, far_mm: float) -> _P:
        """The same probe with another end of its scan lines."""
        changed: _P = replace(self, far_mm=far_mm)  # type: ignore[type-var]  # every member is a dataclass
        return changed

    def frame_picture(self, height: int, width: int) -> Picture:
        """A frame [H, W] as it is."""
        lines, column, row = self.lines, self.lines.span / width, self.scan_line_length_mm / height
        first = lines.start + column / 2, self.near_mm + row / 2
        return Picture(height, width, lines.unit, first, (column, row))

    def picture(self, pixel_mm: float) -> Picture:
        """The picture of the image plane with square pixels."""
        return Picture.over(self.box_mm, pixel_mm)

    def oddities(self) -> Iterator[str]:
        """Sizes that no probe has, as lengths and angles in other units give them, in words."""
        low, high = self.usual_scan_lines_mm
        if not low <= self.scan_line_length_mm <= high:
            yield odd_length("scan lines are", "long", self.scan_line_length_mm, self.usual_scan_lines_mm)


def odd_length(subject: str, measure: str, length_mm: float, usual_mm: tuple[float, float]) -> str:
    """The sentence for a length that no probe has."""
    low, high = usual_mm
    return (
        f"the {subject} {length_mm:.3g} mm {measure}, where {low:g} to {high:g} mm are usual: a length in another "
        "unit? (conf.json is in centimetres, a calibration in millimetres)"
    )


def _in_probe_frame(vectors: FloatArray) -> FloatArray:  # [..., 2] (x, z) -> [..., 3]
    return np.stack([vectors[..., 0], np.zeros(vectors.shape[:-1]), vectors[..., 1]], axis=-1)
