"""The geometry of a fan in an image, and the named transforms of PLUS sequences and device sets that lead to it.

`ProbeToTracker` maps points of Probe to Tracker: p_Tracker = ProbeToTracker · p_Probe, [4, 4], mm; coordinates of
`Image` are pixels.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import cv2
import numpy as np

from ultragray.contract import from_dict
from ultragray.datasets.images import (
    CropBox,
    check_pixel_mm,
    near_sensor,
    parse_crop,
    pixel_size_mm,
    poses_from_image_transforms,
    region_of,
)
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.geometry.image_size import MAX_IMAGE_SIDE
from ultragray.geometry.probe import LARGEST_OPENING_DEG, ConvexProbe, Fan, FloatArray, PhasedProbe, Probe
from ultragray.learn.sweep import ByteArray, Chain, IntArray, Sweep
from ultragray.rendering.display import Display

MAX_DEVICE_SET_BYTES = 8 << 20
_NAME = re.compile(r"([A-Z]\w*?)To([A-Z]\w*)")

TransformName = tuple[str, str]  # from, to


def transform_name(text: str) -> TransformName | None:
    """("Probe", "Tracker") of `ProbeToTracker`; None for another word."""
    match = _NAME.fullmatch(text)
    return None if match is None else (match[1], match[2])


def parse_matrix(text: str, where: str) -> FloatArray:  # [4, 4]
    """Sixteen numbers, row by row, the last row 0 0 0 1. Raises DatasetInvalid, naming `where`."""
    try:
        matrix = np.array([float(word) for word in text.split()])
    except ValueError:
        raise DatasetInvalid(f"{where} must be sixteen numbers, got {text[:80]!r}") from None
    if matrix.size != 16 or not np.isfinite(matrix).all():
        raise DatasetInvalid(f"{where} must be sixteen finite numbers, got {text[:80]!r}")
    matrix = matrix.reshape(4, 4)
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6 or abs(np.linalg.det(matrix[:3, :3])) < 1e-12:
        raise DatasetInvalid(f"{where} must be invertible and end in the row 0 0 0 1, got {text[:200]!r}")
    return matrix


SAME_MATRIX = 1e-3  # mm, and of the entries of a rotation


@dataclass(frozen=True)
class DeviceSet:
    """A PLUS device set (XML)."""

    path: Path
    root: ElementTree.Element
    transforms: Mapping[TransformName, FloatArray]  # under CoordinateDefinitions


def read_device_set(path: Path) -> DeviceSet:
    """Raises DatasetInvalid, naming the file, where it cannot be read or holds no transforms."""
    if not path.is_file():
        raise DatasetInvalid(f"{path}: no such file")
    if path.stat().st_size > MAX_DEVICE_SET_BYTES:
        raise DatasetInvalid(f"{path}: too large for a device set: over {MAX_DEVICE_SET_BYTES >> 20} MiB")
    data = path.read_bytes()
    if b"<!DOCTYPE" in data:  # PLUS writes none; the entities that it could define grow without bounds
        raise DatasetInvalid(f"{path}: a device set has no DOCTYPE")
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise DatasetInvalid(f"{path}: not XML that can be read: {error}") from error
    transforms: dict[TransformName, FloatArray] = {}
    for element in root.iterfind(".//CoordinateDefinitions/Transform"):
        origin, target, text = (element.get(key, "") for key in ("From", "To", "Matrix"))
        if not origin or not target:
            continue
        matrix = parse_matrix(text, f"{path}: {origin}To{target}")
        there, back = transforms.get((origin, target)), transforms.get((target, origin))
        if (there is not None and not np.allclose(there, matrix, atol=SAME_MATRIX)) or (
            back is not None and not np.allclose(back @ matrix, np.eye(4), atol=SAME_MATRIX)
        ):
            raise DatasetInvalid(f"{path}: it has {origin}To{target} twice, with different matrices: leave one of them")
        transforms[origin, target] = matrix
    if not transforms:
        raise DatasetInvalid(f"{path}: it has no Transform under CoordinateDefinitions")
    return DeviceSet(path, root, transforms)


def clip_rectangles(device_set: DeviceSet) -> Iterator[tuple[str, tuple[float, ...]]]:
    """The rectangles of a device set, by the element that has them: column and row of the origin, width and height.

    `VolumeReconstruction` clips images that were recorded, a `Device` those that it is about to record, `Segmentation`
    looks for wires in it.
    """
    for element in device_set.root.iter():
        if element.get("ClipRectangleSize"):
            number = _reader(element, device_set.path)
            origin, size = number("ClipRectangleOrigin", 2), number("ClipRectangleSize", 2)
            if min(size) > 0:
                yield element.tag, (*origin, *size)


def find_path(names: Iterable[TransformName], start: str, goal: str) -> list[tuple[TransformName, bool]] | None:
    """The fewest transforms that lead from `start` to `goal`, in order; True where one is inverted. None: no way."""
    steps: dict[str, list[tuple[str, TransformName, bool]]] = {}
    for origin, target in sorted(set(names)):
        steps.setdefault(origin, []).append((target, (origin, target), False))
        steps.setdefault(target, []).append((origin, (origin, target), True))
    ways: dict[str, list[tuple[TransformName, bool]]] = {start: []}
    reached = [start]
    for place in reached:
        for target, name, inverted in steps.get(place, ()):
            if target not in ways:
                ways[target] = [*ways[place], (name, inverted)]
                reached.append(target)
    return ways.get(goal)


# Fans on a screen: the images of convex and phased probes, brought back to scan lines (range × angle).
#
# The geometry is given in words, or is that of the device set: `ScanConversion` of a CURVILINEAR transducer (mm), or
# the fan that `VolumeReconstruction` clips to (pixels). Sequences of our own exporter say it themselves. Angles are
# counted from the image's depth axis towards its columns.


SQUARE_TOLERANCE = 0.01
SMALLEST_PIXEL_MM = 1e-6
SMALLEST_SHARE = 0.5  # of the fan that must lie in the image
FAN_NAMES = (  # of the fan that PLUS clips to, and of versions before 2.4: angles, apex, end and face
    ("FanAnglesDeg", "FanOriginPixel", "FanRadiusStopPixel", "FanRadiusStartPixel"),
    ("FanAngles", "FanOrigin", "FanDepth"),
)
EXPECTED = "fan must be opening angle (degrees), radius of the face, radius of the end (mm), column, row of the apex"


@dataclass(frozen=True)
class FanGeometry:
    """A fan in images of the orientation MF. Pixels are counted from the centre of the first one."""

    start_deg: float
    stop_deg: float
    near_mm: float
    far_mm: float
    apex_column: float
    apex_row: float

    @property
    def opening_deg(self) -> float:
        return self.stop_deg - self.start_deg

    @property
    def words(self) -> str:
        return (
            f"{self.start_deg:g} to {self.stop_deg:g}°, {self.near_mm:g} to {self.far_mm:g} mm from the apex at "
            f"pixel ({self.apex_column:g}, {self.apex_row:g})"
        )

    def probe(self) -> ConvexProbe | PhasedProbe:
        if self.near_mm == 0.0:
            return PhasedProbe(self.opening_deg, self.far_mm)
        return ConvexProbe(self.opening_deg, self.near_mm, self.far_mm)

    def problem(self) -> str | None:
        """Why there is no such fan, if so."""
        numbers = (self.start_deg, self.stop_deg, self.near_mm, self.far_mm, self.apex_column, self.apex_row)
        if not all(map(math.isfinite, numbers)):
            return "its numbers must be finite"
        if not 0.0 < self.opening_deg <= LARGEST_OPENING_DEG:
            return f"it must open by more than 0 and at most {LARGEST_OPENING_DEG:g}°, got {self.opening_deg:g}"
        if not 0.0 <= self.near_mm < self.far_mm:
            return f"its radii must be 0 or more, the end beyond the face, got {self.near_mm:g} and {self.far_mm:g} mm"
        return None


def parse_fan(text: str) -> FanGeometry:
    """`"60,40,90,319.5,-120"`: opening angle, radii, apex. Raises InvalidArgument."""
    try:
        opening, near, far, column, row = (float(word) for word in text.split(","))
    except ValueError:
        raise InvalidArgument(f"{EXPECTED}, such as 60,40,90,319.5,-120, got {text[:80]!r}", field="fan") from None
    fan = FanGeometry(-opening / 2, opening / 2, near, far, column, row)
    if (problem := fan.problem()) is not None:
        raise InvalidArgument(f"{EXPECTED}: {problem}", field="fan")
    return fan


def fan_of_device_set(device_set: DeviceSet, pixel_mm: tuple[float, float]) -> FanGeometry | None:
    """The fan of a device set for images whose pixels have this size (lateral, axial); None where it has none.

    Raises DatasetInvalid, naming the file, for one that makes no sense, and for several that differ.
    """
    path, root = device_set.path, device_set.root
    lateral_mm, axial_mm = pixel_mm
    fans = set()
    for element in root.iter("ScanConversion"):
        if element.get("TransducerGeometry", "").upper() == "CURVILINEAR":
            number = _reader(element, path)
            (near,), (far,) = number("RadiusStartMm", 1), number("RadiusStopMm", 1)
            (start,), (stop,) = number("ThetaStartDeg", 1), number("ThetaStopDeg", 1)
            column, row = number("TransducerCenterPixel", 2)  # the middle of the face
            fans.add(FanGeometry(start, stop, near, far, column, row - near / axial_mm))
    for element in () if fans else root.iter("VolumeReconstruction"):
        number = _reader(element, path)
        names = next((names for names in FAN_NAMES if element.get(names[0]) is not None), None)
        if names is None or len(set(number(names[0], 2))) == 1:
            continue  # PLUS clips to no fan
        if abs(lateral_mm / axial_mm - 1.0) > SQUARE_TOLERANCE:
            raise DatasetInvalid(
                f"{path}: the radii of its fan are in pixels, which must be square: they are {lateral_mm:g} x "
                f"{axial_mm:g} mm; give the fan in mm"
            )
        (start, stop), (column, row), (far,) = number(names[0], 2), number(names[1], 2), number(names[2], 1)
        (near,) = number(names[3], 1) if len(names) > 3 else (0.0,)
        fans.add(FanGeometry(start, stop, near * axial_mm, far * axial_mm, column, row))
    if len(fans) > 1:
        raise DatasetInvalid(f"{path}: it has {len(fans)} fans that differ; give the one of these images as fan")
    for fan in fans:
        if (problem := fan.problem()) is not None:
            raise DatasetInvalid(f"{path}: its fan cannot be: {problem}")
        return fan
    return None


def fan_of_export(
    fields: Mapping[str, str], image_to_probe: FloatArray | None, path: Path
) -> FanGeometry | None:  # [4, 4] pixels -> mm
    """The fan of a sequence that our own exporter wrote, by its probe; None of a linear one and of other sequences.

    Raises DatasetInvalid, naming the file, for a probe that cannot be, and for one that does not go with ImageToProbe.
    """
    if image_to_probe is None or "UltraGRayProbe" not in fields:
        return None
    try:
        probe = from_dict(Probe, json.loads(fields["UltraGRayProbe"]))
        depth_mm = from_dict(Display, json.loads(fields.get("UltraGRayDisplay", "{}"))).depth_mm
    except (ValueError, RecursionError) as error:
        raise DatasetInvalid(f"{path}: its UltraGRayProbe or UltraGRayDisplay cannot be read: {error}") from error
    if not isinstance(probe, Fan):
        return None
    far_mm = probe.far_mm if depth_mm is None else min(probe.far_mm, probe.face_depth_mm + depth_mm)
    lateral_mm, axial_mm = float(image_to_probe[0, 0]), float(image_to_probe[2, 1])
    if min(abs(lateral_mm), abs(axial_mm)) < SMALLEST_PIXEL_MM:
        raise DatasetInvalid(
            f"{path}: its ImageToProbe must take columns to x and rows to z, as its UltraGRayProbe has it"
        )
    column, row = -image_to_probe[0, 3] / lateral_mm, -image_to_probe[2, 3] / axial_mm
    half_deg = probe.opening_angle_deg / 2
    return FanGeometry(-half_deg, half_deg, probe.near_mm, far_mm, float(column), float(row))


def _reader(element: Element, path: Path) -> Callable[[str, int], tuple[float, ...]]:
    def numbers(key: str, count: int) -> tuple[float, ...]:
        text = element.get(key, "")
        try:
            found = tuple(float(word) for word in text.split())
        except ValueError:
            found = ()
        if len(found) != count:
            raise DatasetInvalid(f"{path}: {element.tag}: {key} must be {count} numbers, got {text[:40]!r}")
        return found

    return numbers


def poses_of_fan(
    top_centres: FloatArray,  # [F, 4, 4]
    fan: FanGeometry,
    column: float,
    row: float,
    pixel_mm: tuple[float, float],
) -> FloatArray:  # [F, 4, 4]
    """Poses whose origin is the apex and whose z is the middle of the fan, from those whose origin is at a place of the
    image."""
    middle = math.radians((fan.start_deg + fan.stop_deg) / 2)
    step = np.eye(4)
    step[:3, :3] = [
        [math.cos(middle), 0.0, math.sin(middle)],
        [0.0, 1.0, 0.0],
        [-math.sin(middle), 0.0, math.cos(middle)],
    ]
    step[0, 3] = (fan.apex_column - column) * pixel_mm[0]
    step[2, 3] = (fan.apex_row - row) * pixel_mm[1]
    poses: FloatArray = top_centres @ step
    return poses


class FanLines:
    """Where the scan lines of a fan lie in images [rows, columns] whose pixels have a size (lateral, axial) in mm.

    As many rows as pixels fit in the depth, as many scan lines as fit in the arc half way. Raises InvalidArgument,
    naming `fan`, where more than half of it lies beyond the image.
    """

    def __init__(self, fan: FanGeometry, size: tuple[int, int], pixel_mm: tuple[float, float]) -> None:
        depth_mm, arc_mm = fan.far_mm - fan.near_mm, math.radians(fan.opening_deg) * (fan.near_mm + fan.far_mm) / 2
        rows, lines = (
            max(1, min(MAX_IMAGE_SIDE, round(extent / side)))
            for extent, side in ((depth_mm, pixel_mm[1]), (arc_mm, pixel_mm[0]))
        )
        radius = fan.near_mm + (np.arange(rows) + 0.5) / rows * depth_mm
        angle = np.radians(fan.start_deg + (np.arange(lines) + 0.5) / lines * fan.opening_deg)
        self._columns = fan.apex_column + radius[:, None] * np.sin(angle) / pixel_mm[0]
        self._rows = fan.apex_row + radius[:, None] * np.cos(angle) / pixel_mm[1]
        within = (np.abs(self._columns - (size[1] - 1) / 2) <= size[1] / 2) & (
            np.abs(self._rows - (size[0] - 1) / 2) <= size[0] / 2
        )
        self.share = float(within.mean())  # of the fan that lies in the image
        if self.share < SMALLEST_SHARE:
            raise InvalidArgument(
                f"fan must lie in the image of {size[1]} x {size[0]} pixels, of {pixel_mm[0]:.3g} x {pixel_mm[1]:.3g} "
                f"mm each, at least by half: {self.share:.0%} of {fan.words} does",
                field="fan",
            )
        places = (self._columns, size[1]), (self._rows, size[0])
        (left, right), (top, bottom) = (
            (max(0, math.floor(one.min() + 0.5)), min(side, math.ceil(one.max() + 0.5))) for one, side in places
        )
        self.box = CropBox(left, right, top, bottom)

    def frames(self, images: ByteArray) -> ByteArray:  # [F, rows, columns] -> [F, H, W]
        """The images between their pixels (bilinear), 0 beyond them."""
        columns, rows = self._columns.astype(np.float32), self._rows.astype(np.float32)
        frames = np.empty((len(images), *columns.shape), np.uint8)
        for image, out in zip(images, frames, strict=True):
            cv2.remap(np.ascontiguousarray(image), columns, rows, cv2.INTER_LINEAR, dst=out)
        return frames


@dataclass(frozen=True)
class ShownFrames:
    """What of images is trained from: their crop, or the scan lines of their fan."""

    frames: ByteArray  # [F, H, W]
    poses: FloatArray  # [F, 4, 4]
    probe: Probe
    box: CropBox
    notes: tuple[str, ...] = ()


def shown_frames(
    images: ByteArray,  # [F, rows, columns]
    top_centres: FloatArray,  # [F, 4, 4] poses whose origin is the top centre of the box
    linear: Probe,  # that spans the box
    box: CropBox,
    fan: FanGeometry | None,
    pixel_mm: tuple[float, float],
) -> ShownFrames:
    """The pixels in a box, or of a fan, of which nothing beyond the box is seen. Raises InvalidArgument."""
    inner = np.s_[:, box.top : box.bottom, box.left : box.right]
    if fan is None:
        frames = np.ascontiguousarray(images[inner])
        return ShownFrames(frames, top_centres, linear, box, _fan_note(frames) if len(frames) else ())
    size = images.shape[1], images.shape[2]
    if (box.height, box.width) != size:
        clipped = np.zeros_like(images)
        clipped[inner] = images[inner]
        images = clipped
    poses = poses_of_fan(top_centres, fan, (box.left + box.right - 1) / 2, box.top - 0.5, pixel_mm)
    lines = FanLines(fan, size, pixel_mm)
    beyond = 1.0 - lines.share
    notes = (f"{beyond:.1%} of the fan lies beyond the image and is black",) if beyond > 1e-3 else ()
    return ShownFrames(lines.frames(images), poses, fan.probe(), lines.box, notes)


BLACK = 16  # at most, of pixels beside a fan: compression leaves them not quite so
UPPER, LOWER = 1 / 8, 1 / 32  # of the sides of an image: corners that are black beside a fan
WIDENS = 0.9  # at most, the width at a quarter of its height over that at three quarters
LEAST_SIDE = 64  # pixels of a picture whose outline can be told


def _fan_note(frames: ByteArray) -> tuple[str, ...]:  # [F, rows, columns]
    """A word about images that look like a fan: whatever any of them shows has its four corners cut and widens.

    The outline is that of the largest connected part, so that text beside it does not count.
    """
    lit = (frames.max(axis=0) > BLACK).astype(np.uint8)
    _, labels, parts, _ = cv2.connectedComponentsWithStats(lit)
    parts[0, cv2.CC_STAT_AREA] = 0  # all that is black
    largest = int(parts[:, cv2.CC_STAT_AREA].argmax())
    left, top, width, height, _ = map(int, parts[largest])
    if largest == 0 or min(width, height) < LEAST_SIDE or width * height < lit.size / 4:
        return ()
    shape = labels[top : top + height, left : left + width] == largest
    (up, across), (low, aside) = ((int(share * height), int(share * width)) for share in (UPPER, LOWER))
    corners = shape[:up, :across], shape[:up, -across:], shape[-low:, :aside], shape[-low:, -aside:]
    upper, lower = (np.ptp(np.flatnonzero(shape[row])) for row in (height // 4, 3 * height // 4))
    middle = shape[:, width // 3 : 2 * width // 3]
    if any(corner.any() for corner in corners) or middle.mean() < 0.5 or upper > WIDENS * lower:
        return ()
    return ("the corners of the images are black, as beside a fan: of a convex or phased probe, name it with fan",)


def tracked_sweep(
    images: ByteArray,  # [F, rows, columns]
    poses: FloatArray,  # [F, 4, 4] sensor→tracker, mm
    image_to_sensor: FloatArray,  # [4, 4] pixels→mm
    numbers: IntArray,  # [F]
    path: Path,
    *,
    crop: str | None,
    fan: str | None,
    calibration: str,
    chain: Chain,
    notes: tuple[str, ...],
    times_s: FloatArray | None = None,
) -> Sweep:
    """The crop of images whose sensor was tracked, or the scan lines of their fan.

    `calibration` names what says how large a pixel is. Raises DatasetInvalid, and InvalidArgument for options that do
    not fit.
    """
    if fan is not None and crop is not None:
        raise InvalidArgument("fan must be given without crop: it says where the image lies", field="fan")
    size = images.shape[1], images.shape[2]
    transforms, box = poses @ image_to_sensor, parse_crop(crop, *size)
    pixel_mm = pixel_size_mm(transforms)
    check_pixel_mm(pixel_mm, min(size), calibration)
    top_centres, linear = poses_from_image_transforms(transforms, box, numbers, path)
    shown = shown_frames(images, top_centres, linear, box, None if fan is None else parse_fan(fan), pixel_mm)
    if crop is None and fan is None:
        notes += (f"no crop was given: the whole image of {size[1]} x {size[0]} pixels is taken as ultrasound",)
    region = region_of(size, shown.box, pixel_mm, image_to_sensor)
    notes = (*notes, *near_sensor(image_to_sensor), *shown.notes)
    return Sweep.of_recording(
        shown.frames,
        shown.poses,
        shown.probe,
        numbers,
        str(path),
        notes,
        times_s=times_s,
        region=region,
        chain=chain,
    )
