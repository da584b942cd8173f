"""Things in the image that the sweep did not have, such as a needle. Needs no torch.

In reading order: where scan lines cross a body (`ScanView`, `Crossing`); `Tool`; convex solids, and the kinds; their
file. A kind is a class: its numbers, and its `crossing`. What that does to a frame, echo, comet tail and shadow,
is in `ultragray.rendering.overlays`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property, reduce
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from typing_extensions import Self

from ultragray.contract import Family, described, from_dict, kind_field, shown, under
from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import (
    MAX_POSITION_MM,
    ROTATION_TOLERANCE,
    check_poses,
    pose_from_position_quaternion,
    quaternion_from_pose,
)
from ultragray.geometry.probe import FWHM_PER_SIGMA, MAX_LENGTH_MM, FloatArray, Probe, length_field

BEAM_MM = 2.5  # full width at half maximum of the slice that tools are seen in, without a beam of frame or scene
LEAST_SLICE_SIGMA_MM = 0.1  # of that slice, where the frames show a thinner one
_LEAST_SPACING_MM = 1e-6


@dataclass(frozen=True, eq=False)
class ScanView:
    """The W scan lines of a probe at C poses, and the slice that they see."""

    probe: Probe
    poses: FloatArray  # [C, 4, 4] mm, probe→scene
    width: int
    slice_sigma_mm: tuple[float, float, float] = (BEAM_MM / FWHM_PER_SIGMA, 0.0, np.inf)  # at the focus; its depth; z_R

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
        rotations, positions = self.poses[:, :3, :3], self.poses[:, :3, 3]
        return (points - positions[:, None]) @ rotations


@dataclass(frozen=True, eq=False)
class Crossing:
    """Scan lines that meet a tool: all [K, C, W], K layers of the slice, whose effects are added up."""

    cover: FloatArray  # share of the line's width that meets it, times the slice's against a tool in its middle; 0 to 1
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


def beam_share(low_mm: FloatArray, high_mm: FloatArray, sigma_mm: FloatArray) -> FloatArray:  # [...] all -> [...]
    """The share of a Gaussian beam that lies between two elevations."""
    scale = 1.0 / (math.sqrt(2.0) * sigma_mm)
    share: FloatArray = 0.5 * np.asarray(_erf(high_mm * scale) - _erf(low_mm * scale), np.float64)
    return share


_erf = np.frompyfunc(math.erf, 1, 1)


def dot(vectors: FloatArray, others: FloatArray) -> FloatArray:  # [..., 3] both -> [...]
    products: FloatArray = (vectors * others).sum(axis=-1)
    return products


MAX_TOOLS = 8  # of one frame
DEFAULT_LABEL = 255
LEAST_THICKNESS_MM = 0.05
_MOST_STOPPED = 1.0 - 1e-6


class ToolFrame(str, Enum):
    """The frame that the points of a tool are in."""

    SCENE = "scene"
    PROBE = "probe"


def point_field(meaning: str, **options: Any) -> Any:
    """A field for the x, y and z of a point, mm."""
    return described(meaning, low=-MAX_POSITION_MM, high=MAX_POSITION_MM, most=3, **options)


def moved_point(pose: FloatArray, point: Sequence[float]) -> tuple[float, float, float]:  # [4, 4] mm, [3] mm
    x, y, z = (pose[:3, :3] @ np.array(point, np.float64) + pose[:3, 3]).tolist()
    return x, y, z


@dataclass(frozen=True, kw_only=True)
class Tool(Family):
    """A rigid body in the image. It reflects as a mirror does, and a little to all sides, and it stops the beam.

    A kind is a class: its numbers, and where scan lines cross the body that they mean (docs/howto/tools.md).
    """

    kind: str
    frame: ToolFrame = described("Of its points; probe: it moves with the probe.", ToolFrame.SCENE)
    brightness: float = described("Echo where a scan line meets it head on.", 1.0, low=0.0, high=1.0)
    roughness: float = described("Share of the brightness that is left at any angle.", 0.25, low=0.0, high=1.0)
    reverberation: float = described(
        "Strength of the first echo of its comet tail, of which each further one has the same share; 0: no tail.",
        0.4,
        low=0.0,
        high=0.9,
    )
    opacity: float = described("Share of the beam that it stops where it is met head on.", 0.6, low=0.0, high=0.999)
    label: int = described("Of its pixels in the output labels.", DEFAULT_LABEL, low=1, high=255)

    @property
    def thickness_mm(self) -> float:
        """Its thickness head on: the distance between the echoes of its comet tail, and what `opacity` is of."""
        raise NotImplementedError

    def crossing(self, view: ScanView) -> Crossing:
        raise NotImplementedError

    def moved(self, pose: FloatArray) -> Self:  # [4, 4] mm, exact
        """The tool in the scene, where its points are in a frame that the pose leads into it."""
        raise NotImplementedError

    def stopped(self, path_mm: FloatArray) -> FloatArray:  # [...] -> [...]
        """The share of the beam that a way through it stops, less than 1."""
        return np.minimum(1.0 - (1.0 - self.opacity) ** (path_mm / self.thickness_mm), _MOST_STOPPED)

    def seen_by(self, view: ScanView, points: Sequence[Sequence[float]]) -> FloatArray:  # [N, 3] -> [C, N, 3]
        array = np.array(points, np.float64)
        if self.frame is ToolFrame.SCENE:
            return view.in_probe_frame(array)
        return np.broadcast_to(array, (len(view.poses), *array.shape))


_LAYERS = np.array([-1.2816, -0.5244, 0.0, 0.5244, 1.2816])  # σ: the middles of fifths of a Gaussian slice
_LEAST = 1e-9


class Span(NamedTuple):
    """The part of lines that lies within a body, all of one shape; none where they leave before they enter."""

    enters: FloatArray  # along the line
    leaves: FloatArray
    head_on: FloatArray  # cosine of the angle between the line and the normal of the side where it enters


SpanOf = Callable[[FloatArray, FloatArray], Span]
"""Of points of lines [..., 3] and their directions [..., 3], in the body's own axes."""


def overlap(one: Span, other: Span) -> Span:
    return Span(
        np.maximum(one.enters, other.enters),
        np.minimum(one.leaves, other.leaves),
        np.where(one.enters >= other.enters, one.head_on, other.head_on),
    )


def between_planes(places: FloatArray, steps: FloatArray, half: float) -> Span:  # [...] both
    """The part of lines within `half` of a plane: their places and steps are those across it."""
    steep = np.where(np.abs(steps) < _LEAST, _LEAST, steps)
    ends = (-half - places) / steep, (half - places) / steep
    return Span(np.minimum(*ends), np.maximum(*ends), np.abs(steps))


def within_radius(places: FloatArray, steps: FloatArray, radius: float) -> Span:  # [..., 2] both
    """The part of lines within `radius` of an axis: their places and steps are those across it."""
    a = np.maximum((steps**2).sum(axis=-1), _LEAST**2)
    b, c = (places * steps).sum(axis=-1), (places**2).sum(axis=-1) - radius**2
    hits = b**2 > a * c
    root = np.sqrt(np.where(hits, b**2 - a * c, 0.0))
    enters = (-b - root) / a
    met = places + enters[..., None] * steps
    leaves = np.where(hits, (-b + root) / a, -np.inf)
    return Span(enters, leaves, np.minimum(np.abs((met * steps).sum(axis=-1)) / radius, 1.0))


def crossing_of_solid(tool: Tool, view: ScanView, placed: FloatArray, span_of: SpanOf) -> Crossing:
    """Where lines meet a body, by five layers of the slice.

    `placed`: [4, 3] mm, its middle and the points 1 mm from there along its own axes.
    """
    seen = tool.seen_by(view, placed.tolist())  # [C, 4, 3]
    middle, axes = seen[:, 0], seen[:, 1:] - seen[:, :1]  # [C, 3], [C, 3, 3]: rows are its axes
    origins, along, _ = view.lines
    depth = dot(middle[:, None] - origins, along)  # [C, W]
    raised = _LAYERS[:, None, None] * view.slice_mm(depth)  # [K, C, W]
    starts = origins - middle[:, None] + raised[..., None] * np.array([0.0, 1.0, 0.0])  # [K, C, W, 3]
    turned = np.einsum("cij,wj->cwi", axes, along)  # [C, W, 3]
    places = np.einsum("cij,kcwj->kcwi", axes, starts)
    span = span_of(places, np.broadcast_to(turned, places.shape))
    face = view.probe.face_depth_mm
    enters = np.maximum(span.enters, face)
    is_met = span.leaves > enters
    enters, path = np.where(is_met, enters, face), np.where(is_met, span.leaves - enters, _LEAST)
    slant = np.sqrt(np.maximum(1.0 - span.head_on**2, 0.0))
    # By as much the side lies higher or lower half a line away.
    rise = 0.5 * view.spacing_mm(enters) * slant / np.maximum(span.head_on, _LEAST)
    rise = np.minimum(rise, path)
    return Crossing(
        cover=is_met / len(_LAYERS),
        first_mm=np.maximum(enters - rise, face),
        last_mm=enters + rise,
        filled_mm=np.maximum(path - rise, 0.0),
        own_first_mm=np.maximum(enters - rise, face),
        own_last_mm=np.maximum(enters + rise, enters + path),
        path_mm=path,
        slant=slant,
        stopped=tool.stopped(path),
    )


@dataclass(frozen=True, kw_only=True)
class Box(Tool):
    """A solid box about a point, turned about it.

    Raises InvalidArgument for a quaternion whose norm is not 1 within 1e-3.
    """

    kind: Literal["box"] = kind_field("box")
    centre_mm: tuple[float, float, float] = point_field("x, y and z of its middle.", example=(0.0, 0.0, 30.0))
    quaternion: tuple[float, float, float, float] = described(
        "w, x, y and z of the rotation from the box to its frame.", (1.0, 0.0, 0.0, 0.0), low=-1.001, high=1.001, most=4
    )
    size_mm: tuple[float, float, float] = described(
        "Lengths along its own x, y and z.",
        low=LEAST_THICKNESS_MM,
        high=MAX_LENGTH_MM,
        most=3,
        example=(20.0, 10.0, 4.0),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        norm = math.hypot(*self.quaternion)
        if abs(norm - 1.0) > ROTATION_TOLERANCE:
            raise InvalidArgument(
                f"quaternion must have norm 1 within {ROTATION_TOLERANCE:g}, got norm {norm:.6g}", field="quaternion"
            )

    @property
    def thickness_mm(self) -> float:
        return min(self.size_mm)

    def moved(self, pose: FloatArray) -> Self:
        box = pose_from_position_quaternion(self.centre_mm, self.quaternion)  # box→frame
        centre_mm, quaternion = moved_point(pose, self.centre_mm), quaternion_from_pose(pose @ box)
        return replace(self, frame=ToolFrame.SCENE, centre_mm=centre_mm, quaternion=quaternion)

    def crossing(self, view: ScanView) -> Crossing:
        pose = pose_from_position_quaternion(self.centre_mm, self.quaternion)  # box→frame
        half = 0.5 * np.array(self.size_mm)

        def span(places: FloatArray, steps: FloatArray) -> Span:
            return reduce(overlap, (between_planes(places[..., i], steps[..., i], half[i]) for i in range(3)))

        return crossing_of_solid(self, view, np.vstack([pose[:3, 3], pose[:3, 3] + pose[:3, :3].T]), span)


@dataclass(frozen=True, kw_only=True)
class Shaft(Tool):
    """A round shaft from its tip to its hub.

    Raises InvalidArgument for a hub at the tip.
    """

    tip_mm: tuple[float, float, float] = point_field("x, y and z of the tip.", example=(8.0, 0.0, 30.0))
    hub_mm: tuple[float, float, float] = point_field("x, y and z of the other end.", example=(-25.0, 0.0, 5.0))
    diameter_mm: float = length_field("Diameter; 0.7 is 22 gauge.", default=0.7, low=LEAST_THICKNESS_MM)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tip_mm == self.hub_mm:
            raise InvalidArgument("hub_mm must differ from tip_mm: they say where it points", field="hub_mm")

    @property
    def thickness_mm(self) -> float:
        return self.diameter_mm

    def moved(self, pose: FloatArray) -> Self:
        tip_mm, hub_mm = moved_point(pose, self.tip_mm), moved_point(pose, self.hub_mm)
        return replace(self, frame=ToolFrame.SCENE, tip_mm=tip_mm, hub_mm=hub_mm)


@dataclass(frozen=True, kw_only=True)
class Cylinder(Shaft):
    """A solid cylinder with flat ends, thicker than the beam: its near side is seen. What is thinner is a needle."""

    kind: Literal["cylinder"] = kind_field("cylinder")

    def crossing(self, view: ScanView) -> Crossing:
        tip, hub = np.array(self.tip_mm), np.array(self.hub_mm)
        length = float(np.linalg.norm(hub - tip))
        axis = (hub - tip) / length
        aside = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        aside /= np.linalg.norm(aside)
        middle = (tip + hub) / 2.0

        def span(places: FloatArray, steps: FloatArray) -> Span:
            wall = within_radius(places[..., :2], steps[..., :2], 0.5 * self.diameter_mm)
            return overlap(wall, between_planes(places[..., 2], steps[..., 2], 0.5 * length))

        axes = np.stack([np.cross(aside, axis), aside, axis])
        return crossing_of_solid(self, view, np.vstack([middle, middle + axes]), span)


_LEAST_NEEDLE = 1e-12


@dataclass(frozen=True, kw_only=True)
class Needle(Shaft):
    """A straight needle. Its echo lies on the line from tip to hub, so that the tip is where it is said to be."""

    kind: Literal["needle"] = kind_field("needle")

    def tip_in_image(self, probe: Probe, poses: Any) -> FloatArray:  # [C, 4, 4] or [4, 4] mm -> [C, 3]
        """Row and column of the tip, from 0 to 1 down and across the image, NaN outside it, and its elevation in mm.

        Raises InvalidPose.
        """
        tip = self.seen_by(ScanView(probe, check_poses(poses), 1), [self.tip_mm])[:, 0]
        rows, columns = probe.image_coordinates(tip[:, 0], tip[:, 2])
        return np.stack([rows, columns, tip[:, 1]], axis=-1)

    def crossing(self, view: ScanView) -> Crossing:
        """Of each line the point of the shaft that is nearest, as the beam sees it, which is thicker than it is wide.

        With q the way from the tip along the shaft, the gap across the line is a + b·q and the elevation y + v·q. The
        point is where (gap / radius)² + (elevation / σ)² is least, σ that of the slice. Half a line's width and the
        slice bound the part of the shaft around it that the line sees: all of a shaft that runs along it.

        Its brightness is that of a shaft in the middle of the beam, so its cover is counted against one there, and is
        less beside the plane. Its shadow is that of the share of the beam that it fills: most of the beam passes a thin
        needle on either side.
        """
        tip, hub = np.moveaxis(self.seen_by(view, (self.tip_mm, self.hub_mm)), 1, 0)[:, :, None]  # [C, 1, 3] each
        length = np.linalg.norm(hub - tip, axis=-1)  # [C, 1]
        shaft = (hub - tip) / length[..., None]
        origins, along, across = view.lines
        radius, face = 0.5 * self.diameter_mm, view.probe.face_depth_mm
        a, b = dot(tip - origins, across), dot(shaft, across)  # [C, W]
        y, v = tip[..., 1], shaft[..., 1]  # [C, 1]
        depth, deeper = dot(tip - origins, along), dot(shaft, along)
        low, high = _bounded(np.zeros_like(a), np.broadcast_to(length, a.shape), -deeper, depth - face)
        sigma = view.slice_mm(depth)
        curvature = (b / radius) ** 2 + (v / sigma) ** 2
        nearest = -(a * b / radius**2 + y * v / sigma**2) / np.maximum(curvature, _LEAST_NEEDLE)
        q = np.clip(nearest, low, np.maximum(low, high))
        spacing, wider = view.spacing_mm(depth + deeper * q), view.turn * deeper
        half = np.maximum(radius * np.abs(v), 0.5 * spacing)
        # Half a line more where the shaft runs along it: its end there is no edge of the shaft.
        steep = 1.0 - np.abs(b)
        inside = np.abs(b) * np.minimum(nearest - low, high - nearest) + 0.5 * spacing * steep
        # The part that is seen: |gap| ≤ room + q·widening, as lines of a fan are wider farther out.
        room = half + 0.5 * steep * spacing - 0.5 * (1.0 + steep) * wider * q
        widening = 0.5 * (1.0 + steep) * wider
        first_q, last_q = _bounded(low, high, b - widening, room - a)
        first_q, last_q = _bounded(first_q, last_q, -b - widening, room + a)
        # Its elevations in the line's width: of a shaft in the plane a diameter, of one across the plane all.
        first_q, last_q = np.minimum(first_q, q), np.maximum(last_q, q)
        middle, reached = y + 0.5 * v * (first_q + last_q), radius + 0.5 * np.abs(v) * (last_q - first_q)
        fills = beam_share(-reached, reached, sigma)
        cover = (
            covered(np.abs(a + b * nearest), half, spacing)
            * covered(-inside, 0.0, spacing)
            * (beam_share(middle - reached, middle + reached, sigma) / fills)
        )
        reach = sigma / np.maximum(np.abs(v), _LEAST_NEEDLE)
        first_q, last_q = np.maximum(first_q, q - reach), np.minimum(last_q, q + reach)
        ends = depth + deeper * first_q, depth + deeper * last_q
        first, last = np.minimum(*ends), np.maximum(*ends)
        path = np.minimum(
            self.diameter_mm / np.sqrt(np.maximum(1.0 - deeper**2, _LEAST_NEEDLE)), length + self.diameter_mm
        )
        # The shaft's own thickness along the line, but not beyond its ends.
        at = depth + deeper * q
        to_tip, to_hub = (way / np.maximum(np.abs(deeper), _LEAST_NEEDLE) for way in (q, length - q))
        above, below = np.where(deeper >= 0.0, to_tip, to_hub), np.where(deeper >= 0.0, to_hub, to_tip)
        return Crossing(
            cover=np.where(low <= high, cover, 0.0)[None],
            first_mm=first[None],
            last_mm=last[None],
            filled_mm=np.zeros_like(path)[None],
            own_first_mm=np.maximum(np.minimum(first, at - np.minimum(0.5 * path, above)), face)[None],
            own_last_mm=np.maximum(last, at + np.minimum(0.5 * path, below))[None],
            path_mm=path[None],
            slant=np.minimum(np.abs(deeper), 1.0)[None],
            stopped=(self.stopped(path) * fills)[None],
        )


def _bounded(low: FloatArray, high: FloatArray, slope: FloatArray, most: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The part of low ≤ q ≤ high where slope·q ≤ most; low > high where there is none."""
    limit = most / np.where(np.abs(slope) < _LEAST_NEEDLE, _LEAST_NEEDLE, slope)
    low = np.where(slope <= -_LEAST_NEEDLE, np.maximum(low, limit), low)
    return low, np.where(slope > -_LEAST_NEEDLE, np.minimum(high, limit), high)


def load_tools(path: str | Path) -> tuple[Tool, ...]:
    """The tools of a `.json` file. Raises InvalidArgument, naming the file, the tool and what was expected."""
    path = Path(path)
    try:
        if not path.is_file():  # a pipe or a device would never end
            raise FileNotFoundError("no such file")
        document = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(document, list):
            raise InvalidArgument(f"it must hold a list of tools, got {shown(document)}")
        tools = []
        for number, one in enumerate(document):
            with under(f"tools[{number}]"):
                tools.append(from_dict(Tool, one))
        return tuple(tools)
    except (OSError, ValueError, RecursionError) as error:  # InvalidArgument is a ValueError
        raise InvalidArgument(f"{path}: {error}", field="tools") from error
