"""Probes: where each pixel lies in the probe frame.

Convention. Probe frame, right-handed: x lateral (image columns, left to right), y elevation, z axial (depth, image
rows). Origin: centre of the transducer face (linear), apex of the fan (convex), both (phased). Images are [H, W]: H
depth samples, W scan lines; sample i lies at depth near + (far − near)·(i+½)/H along its scan line, so the geometry in
mm does not depend on H.

In reading order: bundles of scan lines; `Picture`, the place of pixels in the image plane; `Probe`; its kinds; the
elevational beam. A kind of probe is one class, such as `LinearProbe`: its numbers, and the bundle that they mean.
`Probe` derives the rest, and nothing outside this module asks for a kind. Backends take probes by way of
`ultragray.rendering.backends.inputs`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

from ultragray.contract import Contract, Family, annotated_fields, described, kind_field
from ultragray.errors import InvalidArgument, InvalidProbe

# Bundles of scan lines in an image plane: where they run, and which of them goes through a point.
#
# The place of a line is its `across`, a number that grows evenly from line to line, in mm or degrees: of W lines,
# line j has start + span·(j+½)/W. A point of the plane has x and z, lateral and axial, or its depth along the line
# through it and the across of that line.

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


class Edges(NamedTuple):
    """The outermost lines of a bundle: a point x, z mm is `scale`·|x − slope·z| − across·z − half mm off them.

    Less than 0 is between them. Its depth is `by_z`·z or, where lines are `fanned` out, its distance to the origin.
    """

    fanned: bool
    slope: float
    scale: float
    across: float
    half: float
    by_z: float


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
        return self.start + self.span * ((np.arange(width) + 0.5) / width)

    @abstractmethod
    def rays(self, across: FloatArray) -> tuple[FloatArray, FloatArray]:  # [...] -> [..., 2] both
        """Origins of the lines, at depth 0, and their unit directions: x and z of each."""

    @abstractmethod
    def coordinates(self, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Depth and across of points; a depth of NaN where no line of the bundle, however wide, comes by."""

    @property
    @abstractmethod
    def edges(self) -> Edges:
        """Where the outermost lines are."""

    @abstractmethod
    def box(self, near_mm: float, far_mm: float) -> Box:
        """Around the lines from one depth to another."""

    @abstractmethod
    def breadth_mm(self, depth_mm: float) -> float:
        """Length of a row of the image at a depth."""

    @abstractmethod
    def moved(self, across: float) -> FloatArray:  # [4, 4] mm
        """The motion, in the frame of the probe, that puts every line where one so far across from it was."""

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
        steering = math.radians(self.steering_deg)
        return math.sin(steering), math.cos(steering)

    def rays(self, across: FloatArray) -> tuple[FloatArray, FloatArray]:
        origins = np.stack([across, np.zeros_like(across)], axis=-1)
        return origins, np.broadcast_to(self.direction, origins.shape).copy()

    def coordinates(self, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        along_x, along_z = self.direction
        return z / along_z, x - z * (along_x / along_z)

    @property
    def edges(self) -> Edges:
        along_x, along_z = self.direction
        return Edges(False, along_x / along_z, along_z, 0.0, self.span / 2 * along_z, 1.0 / along_z)

    def box(self, near_mm: float, far_mm: float) -> Box:
        along_x, along_z = self.direction
        shifts = (near_mm * along_x, far_mm * along_x)
        return Box(min(shifts) - self.span / 2, max(shifts) + self.span / 2, near_mm * along_z, far_mm * along_z)

    def breadth_mm(self, depth_mm: float) -> float:
        return self.span

    def moved(self, across: float) -> FloatArray:  # [4, 4] mm
        motion = np.eye(4)
        motion[0, 3] = across
        return motion

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

    def moved(self, across: float) -> FloatArray:  # [4, 4] mm
        motion, angle = np.eye(4), math.radians(across)
        motion[0, 0] = motion[2, 2] = math.cos(angle)
        motion[0, 2], motion[2, 0] = math.sin(angle), -math.sin(angle)
        return motion


@dataclass(frozen=True)
class FannedLines(_Angular):
    """A fan about z, `span` degrees wide, less than 180."""

    span: float

    corner_shares: ClassVar[tuple[float, ...]] = (0.0, 0.5, 1.0)

    def coordinates(self, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.where(z > 0, np.hypot(x, z), np.nan), np.degrees(np.arctan2(x, z))

    @property
    def edges(self) -> Edges:
        half = math.radians(self.span / 2)
        return Edges(True, 0.0, math.cos(half), math.sin(half), 0.0, 1.0)

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

    @property
    def edges(self) -> Edges:
        return Edges(True, 0.0, 0.0, 0.0, 0.0, 1.0)  # there are none

    def box(self, near_mm: float, far_mm: float) -> Box:
        return Box(-far_mm, far_mm, -far_mm, far_mm)


Lines: TypeAlias = ParallelLines | FannedLines | RadialLines


@dataclass(frozen=True)
class Picture:
    """The grid of a picture [H, W].

    Columns are counted in mm along x (`column_unit` "mm") or, where each is one of angular scan lines, in degrees from
    z ("deg"); rows in mm along z, or along the scan lines. Where these are steered, a column is where its line leaves
    the face. `first` is the centre of pixel (0, 0), (column, row), `step` the way to the next one, negative where the
    picture is flipped.
    """

    height: int = described("H.")
    width: int = described("W.")
    column_unit: str = described("mm or deg.", choices=("mm", "deg"))
    first: tuple[float, float] = described("Column and row of the centre of pixel (0, 0).")
    step: tuple[float, float] = described("To the next column and row.")

    @property
    def first_column(self) -> float:
        """Centre of the first pixel, in the unit of the columns."""
        return self.first[0]

    @property
    def first_row_mm(self) -> float:
        return self.first[1]

    @property
    def column_step(self) -> float:
        return self.step[0]

    @property
    def row_step_mm(self) -> float:
        return self.step[1]

    @classmethod
    def over(cls, box: Box, pixel_mm: float) -> Picture:
        """Square pixels over a box of the image plane, from its upper edge on, as many to the left as to the right."""
        columns, rows = (max(1, math.ceil(side / pixel_mm)) for side in (box.right - box.left, box.bottom - box.top))
        middle = (box.left + box.right) / 2
        first = middle + (1 - columns) * pixel_mm / 2, box.top + pixel_mm / 2
        return cls(rows, columns, "mm", first, (pixel_mm, pixel_mm))

    def positions_mm(self) -> tuple[FloatArray, FloatArray]:  # [1, W], [H, 1]
        """Column and row of each pixel's centre, in the units of the picture."""
        columns = self.first[0] + self.step[0] * np.arange(self.width, dtype=np.float64)
        rows = self.first[1] + self.step[1] * np.arange(self.height, dtype=np.float64)
        return columns[None, :], rows[:, None]

    def flipped(self) -> Picture:
        last = self.first[0] + (self.width - 1) * self.step[0]
        return replace(self, first=(last, self.first[1]), step=(-self.step[0], self.step[1]))


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
    dicom_type: ClassVar[str | None] = None  # TransducerType (PS3.3 C.8.5.6); None: none of its terms fits
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
        return math.inf if height == 1 else self.near_mm + self.scan_line_length_mm * (height - 1) / height

    def cull(self, x_mm: FloatArray, z_mm: FloatArray, height: int) -> BoolArray:  # [N] each
        """A mask of the means of Gaussians that count, by their depth: up to the top edge of the last row."""
        depth, _ = self.lines.coordinates(x_mm, z_mm)
        return (depth >= self.near_mm) & (depth <= self.cull_far_mm(height))

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

    def corners_from(self, poses: FloatArray) -> FloatArray:  # [C, 4, 4] mm -> [C, 2·K, 3]
        """`corners_mm` in the frame that poses lead into."""
        corners: FloatArray = np.einsum("fij,cj->fci", poses[:, :3, :3], self.corners_mm()) + poses[:, None, :3, 3]
        return corners

    def cropped(self, share: float) -> Self:
        """The same probe with scan lines that end after this share of their length."""
        return self.ending_at(self.near_mm + share * self.scan_line_length_mm)

    def ending_at(self, far_mm: float) -> Self:
        """The same probe with another end of its scan lines."""
        return replace(self, far_mm=far_mm)  # type: ignore[type-var]  # every member is a dataclass

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
    low, high = usual_mm
    return (
        f"the {subject} {length_mm:.3g} mm {measure}, where {low:g} to {high:g} mm are usual: a length in another "
        "unit? (conf.json is in centimetres, a calibration in millimetres)"
    )


def _in_probe_frame(vectors: FloatArray) -> FloatArray:  # [..., 2] (x, z) -> [..., 3]
    return np.stack([vectors[..., 0], np.zeros(vectors.shape[:-1]), vectors[..., 1]], axis=-1)


LARGEST_OPENING_DEG = 175.0
SMALLEST_USUAL_OPENING_DEG = 5.0


def opening_field() -> Any:
    return described("Full angle of the fan.", above=0.0, high=LARGEST_OPENING_DEG, example=60.0)


class Fan(Probe):
    """A probe whose scan lines fan out from an apex at the origin, at even angles."""

    opening_angle_deg: float

    @property
    def lines(self) -> FannedLines:
        return FannedLines(self.opening_angle_deg)

    @property
    def face_depth_mm(self) -> float:
        return self.near_mm

    def oddities(self) -> Iterator[str]:
        yield from super().oddities()
        if self.opening_angle_deg < SMALLEST_USUAL_OPENING_DEG:
            yield (
                f"the fan opens by {self.opening_angle_deg:.3g}°, where {SMALLEST_USUAL_OPENING_DEG:g}° and more are "
                "usual: an angle in radians? (conf.json is in degrees)"
            )


@dataclass(frozen=True)
class ConvexProbe(Fan):
    """A curved array: scan lines fan out from the apex, which is the origin."""

    opening_angle_deg: float = opening_field()
    near_mm: float = length_field("Radius of the face: distance from the apex at which the image begins.", example=40.0)
    far_mm: float = length_field(
        "Distance from the apex at which the image ends, beyond `near_mm`.", above=0.0, example=90.0
    )
    kind: Literal["convex"] = kind_field("convex")

    dicom_type = "CURVED LINEAR"


USUAL_WIDTHS_MM = (5.0, 200.0)


@dataclass(frozen=True)
class LinearProbe(Probe):
    """A linear array: parallel scan lines along +z, the face centred on the origin."""

    width_mm: float = length_field("Width of the face.", above=0.0, example=40.0)
    near_mm: float = length_field("Depth at which the image begins.", example=0.0)
    far_mm: float = length_field("Depth at which the image ends, beyond `near_mm`.", above=0.0, example=50.0)
    kind: Literal["linear"] = kind_field("linear")

    dicom_type = "LINEAR"
    face_depth_mm = 0.0

    @property
    def lines(self) -> ParallelLines:
        return ParallelLines(self.width_mm)

    def oddities(self) -> Iterator[str]:
        if not USUAL_WIDTHS_MM[0] <= self.width_mm <= USUAL_WIDTHS_MM[1]:
            yield odd_length("image is", "wide", self.width_mm, USUAL_WIDTHS_MM)
        yield from super().oddities()


@dataclass(frozen=True)
class PhasedProbe(Fan):
    """A phased array: scan lines fan out from the centre of the face; `near_mm` is 0."""

    opening_angle_deg: float = opening_field()
    far_mm: float = length_field("Depth at which the image ends.", above=0.0, example=50.0)
    kind: Literal["phased"] = kind_field("phased")

    dicom_type = "SECTOR_PHASED"
    near_mm = 0.0


@dataclass(frozen=True)
class RadialProbe(Probe):
    """Scan lines all the way round in the image plane, outwards from a ring about the origin.

    Line j of W runs at the angle 360°·(j+½)/W from z towards +x; the last is followed by the first.
    """

    near_mm: float = length_field(
        "Radius of the ring: distance from the centre at which the image begins.", example=1.0
    )
    far_mm: float = length_field(
        "Distance from the centre at which the image ends, beyond `near_mm`.", above=0.0, example=20.0
    )
    kind: Literal["radial"] = kind_field("radial")

    usual_scan_lines_mm = (1.0, 150.0)

    @property
    def lines(self) -> RadialLines:
        return RadialLines()

    @property
    def face_depth_mm(self) -> float:
        return self.near_mm

    @property
    def pivot_depth_mm(self) -> float:
        return 0.0


LARGEST_STEERING_DEG = 45.0


@dataclass(frozen=True)
class SteeredProbe(Probe):
    """A linear array whose scan lines, parallel, leave the face at an angle; depths are along the lines."""

    width_mm: float = length_field("Width of the face.", above=0.0, example=40.0)
    steering_deg: float = described(
        "Angle of the scan lines from the axial axis, positive towards +x.",
        low=-LARGEST_STEERING_DEG,
        high=LARGEST_STEERING_DEG,
        example=15.0,
    )
    near_mm: float = length_field("Depth along the scan lines at which the image begins.", example=0.0)
    far_mm: float = length_field(
        "Depth along the scan lines at which the image ends, beyond `near_mm`.", above=0.0, example=50.0
    )
    kind: Literal["steered"] = kind_field("steered")

    dicom_type = "LINEAR"
    face_depth_mm = 0.0

    @property
    def lines(self) -> ParallelLines:
        return ParallelLines(self.width_mm, self.steering_deg)


# Probes by the names that makers give theirs: the lowest and highest frequency, MHz, after a letter for the shape.
# Widths, radii and angles are typical of probes of that name, and depths of their use: those of one's own differ.
Probe.named = MappingProxyType(
    {
        "C5-2": ConvexProbe(opening_angle_deg=70.0, near_mm=50.0, far_mm=200.0),  # abdomen
        "C9-4": ConvexProbe(opening_angle_deg=130.0, near_mm=11.0, far_mm=91.0),  # endocavity
        "L7-4": LinearProbe(width_mm=38.0, near_mm=0.0, far_mm=80.0),  # vessels
        "L12-4": LinearProbe(width_mm=38.0, near_mm=0.0, far_mm=60.0),  # small parts, muscles, vessels
        "L15-7": LinearProbe(width_mm=25.0, near_mm=0.0, far_mm=40.0),  # near the skin, hockey stick
        "P4-2": PhasedProbe(opening_angle_deg=90.0, far_mm=160.0),  # heart
    }
)

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
MAX_THICKNESS_MM = 100.0
MIN_DEPTH_OF_FIELD_MM = 0.1


@dataclass(frozen=True)
class ElevationBeam(Contract):
    """A Gaussian beam across the image plane, with a focus (docs/physics.md §3).

    Its thickness at a depth s is thickness_mm·√(1 + ((s − focus_mm)/z_R)²), its Rayleigh range z_R half the depth of
    field. With neither focus nor depth of field it is as thick at every depth.
    Raises InvalidArgument for one of the two without the other.
    """

    thickness_mm: float = described(
        "Thickness at the focus: full width at half maximum along elevation.", low=0.0, high=MAX_THICKNESS_MM
    )
    focus_mm: float | None = length_field(
        "Depth of the focus below the probe's face; none: the same thickness at every depth.", default=None
    )
    depth_of_field_mm: float | None = described(
        "Depth over which it is at most √2 times as thick as at the focus: twice the Rayleigh range.",
        None,
        low=MIN_DEPTH_OF_FIELD_MM,
        high=MAX_LENGTH_MM,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.focus_mm is None) != (self.depth_of_field_mm is None):
            missing = "focus_mm" if self.focus_mm is None else "depth_of_field_mm"
            raise InvalidArgument(
                f"{missing} must be given: a beam has a focus and a depth of field, or neither", field=missing
            )

    @property
    def numbers(self) -> tuple[float, float, float]:
        """Thickness, focus and depth of field in mm; focus 0 and an infinite depth of field where it has none."""
        if self.focus_mm is None or self.depth_of_field_mm is None:
            return self.thickness_mm, 0.0, math.inf
        return self.thickness_mm, self.focus_mm, self.depth_of_field_mm

    def thickness_at_mm(self, depth_mm: float) -> float:
        """Full width at half maximum at a depth below the face."""
        thickness, focus, depth_of_field = self.numbers
        return thickness * math.hypot(1.0, 2.0 * (depth_mm - focus) / depth_of_field)


PLANE = ElevationBeam(thickness_mm=0.0)  # no beam: an infinitely thin slice
