"""Sequences recorded with PLUS: tracked 2D images in MetaImage or NRRD files.

The pose of a frame follows from its transforms and the device set's: from the frame of the stored pixels, `Image` or
what it was cropped to, to `Reference` where that is tracked, else to `Tracker`; usually inv(ReferenceToTracker) ·
ProbeToTracker · ImageToProbe.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ultragray.datasets.clocks import delay_note, parse_delay_ns, poses_before, times_of_all
from ultragray.datasets.fan import (
    DeviceSet,
    FanGeometry,
    TransformName,
    clip_rectangles,
    fan_of_device_set,
    fan_of_export,
    find_path,
    parse_fan,
    parse_matrix,
    read_device_set,
    shown_frames,
    transform_name,
)
from ultragray.datasets.images import (
    CropBox,
    check_pixel_mm,
    grey_frames,
    near_sensor,
    parse_crop,
    pixel_size_mm,
    poses_from_image_transforms,
    region_of,
)
from ultragray.datasets.plus_files import UNKNOWN, StoredSequence, orient_frames, read_meta_image, read_nrrd
from ultragray.errors import DatasetInvalid, InvalidArgument, InvalidPose
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray
from ultragray.learn.sweep import Chain, Link, Sweep, frame_list, parse_frame_ranges

_READERS = {".mha": read_meta_image, ".mhd": read_meta_image, ".nrrd": read_nrrd, ".nhdr": read_nrrd}
IMAGE, PROBE, WORLDS = "Image", "Probe", ("Reference", "Tracker", "World")
_TRANSFORM, _STATUS = "Transform", "TransformStatus"
_IMAGE_STATUSES = ("ImageStatus", "Status")  # as MetaImage and NRRD sequences call it
_TIMES = ("Timestamp", "UnfilteredTimestamp")
_NO_NUMBER = re.compile(r"(?i)nan|#ind")  # in a matrix: of a tracker that has lost the probe
_DEPTH = re.compile(r"(?i).*depth_?(mm|cm)?")
_PERSON = re.compile(r"(?i)(.*[^a-z])?(patient|subject|mrn|accession|birth).*")
SAME_SPACING = 0.02  # relative
SAME_MM = 0.01  # by which two ways between frames may differ: trackers write six digits


def read_plus_sweep(
    path: Path,
    *,
    device_set: Path | None = None,
    frames: str | None = None,
    crop: str | None = None,
    fan: str | None = None,
    transform: str | None = None,
    image_delay_ms: str | None = None,
) -> tuple[Sweep, int]:
    """The frames of a sequence that have a valid pose, and the number of frames in the file.

    `frames` (ranges, `parse_frame_ranges`) chooses among them, `crop` is "columns,rows" of the image after it was
    brought to x lateral, y depth; without it the rectangle that the device set clips volumes to is taken. `fan`
    (`parse_fan`), or without `crop` the fan of the device set or of our own export, says that the images are those of a
    convex or phased probe on a screen: the frames are its scan lines, the poses have their origin at the apex.
    `transform` names the tracked transform to take, such as ProbeToTracker, where there are several trackers: poses are
    then in the frame that it leads to. A calibration of the device set (from or to an image) goes before one of the
    same name in the sequence, a tracked transform before one of the device set. `image_delay_ms` is by how much the
    images are stamped later than the poses. Frames whose status is not OK are left out, and the sweep's notes say so; a
    sequence without statuses is taken to be valid. Raises DatasetInvalid, naming the file, the frame and the reason;
    InvalidArgument for options that do not fit.
    """
    if fan is not None and crop is not None:
        raise InvalidArgument("fan must be given without crop: it says where the image lies", field="fan")
    delay_ns = parse_delay_ns(image_delay_ms)
    stored = _READERS[path.suffix.lower()](path)
    frame_count = len(stored.pixels)
    chosen = range(frame_count) if frames is None else parse_frame_ranges(frames, frame_count, option="frames")
    orientation = _field(stored, "UltrasoundImageOrientation").upper()
    known = None if device_set is None else read_device_set(device_set)
    way = _Way.of(stored, known, transform)
    numbers, transforms, left_out = way.of_frames(range(frame_count) if delay_ns else chosen)
    times_s, time_notes = _times(stored, numbers)
    pixel_mm = pixel_size_mm(transforms)
    check_pixel_mm(pixel_mm, min(stored.pixels.shape[1:3]), way.calibration_source)
    images = orient_frames(grey_frames(stored.pixels, str(path)), orientation, path)
    size = images.shape[1], images.shape[2]
    calibration, to_pixels = way.to_probe(numbers[0]), way.image_to_pixels(numbers[0])
    fan_geometry, notes = None if fan is None else parse_fan(fan), list(way.notes)
    box = parse_crop(crop, *size)
    is_whole = crop is None and fan is None
    if crop is None and fan is None:
        fan_geometry, fan_notes = _fan_of(stored, known, calibration, to_pixels, pixel_mm)
        clip, clip_notes = _clip_of(known, to_pixels, size)
        box, is_whole = clip or box, clip is None and fan_geometry is None
        notes += [*fan_notes, *clip_notes]
    poses, linear = poses_from_image_transforms(transforms, box, numbers, path)
    if delay_ns:
        poses, is_known = poses_before(poses, times_s, delay_ns, path)
        is_known &= np.isin(numbers, np.array(chosen))
        if not is_known.any():
            raise DatasetInvalid(f"{path}: no frame has a pose {delay_ns / 1e6:g} ms before its time: a wrong delay?")
        left_out |= {int(number): "no pose" for number in set(numbers[~is_known]) & set(chosen)}
        numbers, poses = numbers[is_known], poses[is_known]
        times_s = None if times_s is None else times_s[is_known]
    shown = shown_frames(images[numbers], poses, linear, box, fan_geometry, pixel_mm)
    sweep = Sweep.of_recording(
        images=shown.frames,
        poses=shown.poses,
        probe=shown.probe,
        frame_numbers=numbers,
        source=str(path),
        region=region_of(size, shown.box, pixel_mm, calibration),
        notes=(
            *stored.notes,
            *_notes(stored, numbers, orientation, size if is_whole else None, left_out),
            *notes,
            *_odd_lengths(stored, calibration, pixel_mm),
            *shown.notes,
            *time_notes,
            *delay_note(delay_ns),
        ),
        chain=way.chain,
        times_s=times_s,
    )
    return sweep, frame_count


def _field(stored: StoredSequence, name: str) -> str:
    """A field of the file; NRRD sequences write `ultrasound image orientation`."""
    for key, value in stored.fields.items():
        if key.replace(" ", "").lower() == name.lower():
            return value
    return ""


def _times(stored: StoredSequence, numbers: np.ndarray) -> tuple[FloatArray | None, tuple[str, ...]]:  # [F]
    """The times of frames, in seconds, and what is to be told of them; None where one has none."""
    notes: tuple[str, ...] = ()
    for key in _TIMES:
        if any(key in stored.frame_fields[number] for number in numbers):
            times_s, why_none = times_of_all(
                np.array([_number(stored.frame_fields[number].get(key)) for number in numbers])
            )
            if times_s is not None:
                return times_s, ()
            notes = notes or why_none
    return None, notes


def _number(text: str | None) -> float:
    """NaN where it is none."""
    try:
        return float(text or "nan")
    except ValueError:
        return math.nan


@dataclass(frozen=True)
class _Way:
    """The transforms from the stored pixels to the frame that poses are given in, the same for every frame."""

    stored: StoredSequence
    steps: tuple[tuple[TransformName, bool], ...]  # True: inverted
    fixed: Mapping[TransformName, FloatArray]  # those that are the same in every frame
    sources: Mapping[TransformName, str]  # of all transforms
    notes: tuple[str, ...]

    @classmethod
    def of(cls, stored: StoredSequence, device_set: DeviceSet | None, transform: str | None) -> _Way:
        path, notes = stored.path, []
        in_frames = Counter(
            name
            for fields in stored.frame_fields
            for key in fields
            if key.endswith(_TRANSFORM) and (name := transform_name(key.removesuffix(_TRANSFORM)))
        )
        sources = dict.fromkeys(in_frames, path.name)
        fixed: dict[TransformName, FloatArray] = {}
        for name, count in in_frames.items():
            if IMAGE in name and count < len(stored.frame_fields):  # a calibration that was written once
                (value, *others) = {fields.get("To".join(name) + _TRANSFORM) for fields in stored.frame_fields} - {None}
                if not others:
                    fixed[name] = parse_matrix(str(value), f"{path}: {'To'.join(name)}")
                    notes.append(f"{'To'.join(name)} is in {count} of {len(stored.frame_fields)} frames: taken for all")
        for name, matrix in ({} if device_set is None else device_set.transforms).items():
            where = "" if device_set is None else device_set.path.name
            same = next((one for one in (name, name[::-1]) if one in in_frames), None)
            if same is not None and not any(part.endswith(IMAGE) for part in name):
                notes.append(f"{'To'.join(name)} of {where} is left out: the sequence tracks {'To'.join(same)}")
                continue
            if same is not None:
                sources.pop(same)
                fixed.pop(same, None)
                if (found := _difference(stored, same, matrix if same == name else _inverse(matrix))) is not None:
                    notes.append(f"{'To'.join(same)} of the sequence is left out, {where} has another one: {found}")
            sources[name], fixed[name] = where, matrix
            if IMAGE in name and np.array_equal(matrix, np.eye(4)):
                notes.append(f"{'To'.join(name)} of {where} is the identity: was the probe never calibrated?")
        pixels = _pixel_frame(stored, sources, fixed)
        steps = _steps(stored, pixels, sources, device_set, transform)
        return cls(stored, steps, fixed, sources, (*notes, *_contradictions(stored, steps, sources, fixed)))

    @property
    def chain(self) -> Chain:
        links = []
        for name, is_inverted in self.steps:
            origin, target = name[::-1] if is_inverted else name
            is_tracked = name not in self.fixed and len(_values(self.stored, name)) > 1
            links.append(Link(origin, target, "To".join(name), self.sources[name], is_inverted, is_tracked))
        used = {name for name, _ in self.steps}
        others = (f"{'To'.join(name)} of {source}" for name, source in sorted(self.sources.items()) if name not in used)
        return Chain(tuple(links), tuple(others))

    @property
    def calibration_source(self) -> str:
        """The transforms that say how large a pixel is, and their file."""
        names = [name for name, _ in self.steps if any(part.endswith(IMAGE) for part in name)]
        listed = " and ".join("To".join(name) for name in names)
        return f"{self.sources[names[-1]] if names else self.stored.path}: {listed}"

    def of_frames(self, chosen: Iterable[int]) -> tuple[np.ndarray, FloatArray, dict[int, str]]:  # [F], [F, 4, 4]
        """Numbers of the chosen frames that are valid, their transforms from pixels to the world, and why others are
        left out."""
        reasons = {number: self._why_invalid(self.stored.frame_fields[number]) for number in chosen}
        valid = [number for number, reason in reasons.items() if not reason]
        left_out = {number: reason for number, reason in reasons.items() if reason}
        if not valid:
            tracked = " and ".join("To".join(name) for name, _ in self.steps if name not in self.fixed) or "image"
            raise DatasetInvalid(
                f"{self.stored.path}: none of its {len(reasons)} frames has a valid {tracked}: {_counted(left_out)}"
            )
        transforms = np.stack([self._product(number, self.steps) for number in valid])
        return np.array(valid, np.int64), transforms, left_out

    def to_probe(self, number: int) -> FloatArray | None:  # [4, 4]
        """The calibration from pixels to the probe, as it was used, of a frame; None where there is no such frame."""
        ends = [name[0] if is_inverted else name[1] for name, is_inverted in self.steps]
        return self._product(number, self.steps[: ends.index(PROBE) + 1]) if PROBE in ends else None

    def image_to_pixels(self, number: int) -> FloatArray:  # [4, 4]
        """From `Image` to the stored pixels, which may be cropped."""
        ends = [name[0] if is_inverted else name[1] for name, is_inverted in self.steps]
        count = ends.index(IMAGE) + 1 if IMAGE in ends else 0
        return _inverse(self._product(number, self.steps[:count]))

    def _product(self, number: int, steps: Iterable[tuple[TransformName, bool]]) -> FloatArray:  # [4, 4]
        product: FloatArray = np.eye(4)
        for name, is_inverted in steps:
            step = self.fixed[name] if name in self.fixed else _measured(self.stored, number, name)
            product = (_inverse(step) if is_inverted else step) @ product
        return product

    def _why_invalid(self, fields: Mapping[str, str]) -> str:
        statuses = {key: fields.get(key, "OK") for key in _IMAGE_STATUSES}
        for name, _ in self.steps:
            key = "To".join(name)
            if name not in self.fixed:
                value, status = fields.get(key + _TRANSFORM), fields.get(key + _STATUS, "OK")
                is_lost = status.upper() == "OK" and _NO_NUMBER.search(value or "") is not None
                statuses[key] = "missing" if value is None else "NaN" if is_lost else status
        return ", ".join(f"{key} {status[:20]}" for key, status in statuses.items() if status.upper() != "OK")


def _inverse(matrix: FloatArray) -> FloatArray:  # [4, 4]
    return np.asarray(np.linalg.inv(matrix), np.float64)


def _values(stored: StoredSequence, name: TransformName) -> set[str]:
    key = "To".join(name) + _TRANSFORM
    return {" ".join(fields[key].split()) for fields in stored.frame_fields if key in fields}


def _difference(stored: StoredSequence, name: TransformName, matrix: FloatArray) -> str | None:
    """How far a transform of the sequence is from that of the device set, in words; None: they are the same."""
    own = (_together(stored, [name], {}) or [matrix])[0]
    if np.allclose(own, matrix, rtol=1e-5, atol=1e-5):
        return None
    (before, after), shift = (np.linalg.norm(one[:3, :2], axis=0) for one in (own, matrix)), own[:3, 3] - matrix[:3, 3]
    return (
        f"pixels of {before[0]:.4g} x {before[1]:.4g} and {after[0]:.4g} x {after[1]:.4g} mm, origins "
        f"{np.linalg.norm(shift):.3g} mm apart"
    )


def _pixel_frame(
    stored: StoredSequence, sources: Mapping[TransformName, str], fixed: Mapping[TransformName, FloatArray]
) -> str:
    """The frame of the stored pixels: `Image`, or the last frame that it was cropped or resized to.

    PLUS's tools write `ImageToCroppedImage` into every frame. A frame whose name ends so is one of pixels where the
    transform moves and scales within the plane alone: others, such as ImageToMRImage, are registrations.
    """
    others: dict[str, list[str]] = {}
    for name in sources:
        if all(part.endswith(IMAGE) for part in name) and (found := _together(stored, [name], fixed)) is not None:
            in_plane = found[0].copy()
            in_plane[2, 2] = 1.0
            in_plane[[0, 1], [0, 1]] = 1.0
            in_plane[:2, 3] = 0.0
            if np.abs(in_plane - np.eye(4)).max() < 1e-6:
                for origin, target in (name, name[::-1]):
                    others.setdefault(origin, []).append(target)
    place, before = IMAGE, ""
    while further := [one for one in others.get(place, ()) if one != before]:
        if len(further) > 1 or further[0] == IMAGE:
            raise DatasetInvalid(
                f"{stored.path}: it does not say which of the images its pixels are: {place} leads to "
                f"{' and '.join(sorted(further))}"
            )
        place, before = further[0], place
    return place


def _steps(
    stored: StoredSequence,
    pixels: str,
    sources: Mapping[TransformName, str],
    device_set: DeviceSet | None,
    transform: str | None,
) -> tuple[tuple[TransformName, bool], ...]:
    known = ", ".join(sorted(map("To".join, sources))) or "none"
    if transform is not None:
        wanted = transform_name(transform)
        if wanted is None or wanted not in sources:
            raise InvalidArgument(
                f"transform must be one of the sequence, such as ProbeToTracker; there are {known}, got "
                f"{transform[:80]!r}",
                field="transform",
            )
        before = find_path({*sources} - {wanted}, pixels, wanted[0])
        if before is None:
            raise DatasetInvalid(f"{stored.path}: no transforms lead from {pixels} to {wanted[0]}; there are {known}")
        return (*before, (wanted, False))
    for world in WORLDS:
        if way := find_path(sources, pixels, world):
            return tuple(way)
    if not any(key.endswith(_TRANSFORM) for fields in stored.frame_fields for key in fields):
        raise DatasetInvalid(
            f"{stored.path}: its frames have no transforms: 3D Slicer saves images and transforms apart, PLUS and "
            "SlicerIGSIO in one sequence file (.igs.mha), which is needed"
        )
    is_calibrated = any(part.endswith(IMAGE) for name in sources for part in name)
    reached = {frame for name in sources for frame in name if find_path(sources, pixels, frame)}
    goes_on = any({*name} <= reached and not any(part.endswith(IMAGE) for part in name) for name in sources)
    hint = " (say with transform which to take)" if goes_on else " (give the device set that holds ImageToProbe)"
    if is_calibrated and not goes_on:
        hint = f" ({pixels} leads to {', '.join(sorted(reached))} alone: has the probe another name in the sequence?)"
    raise DatasetInvalid(
        f"{stored.path}: no transforms lead from {pixels} to {', '.join(WORLDS[:-1])} or {WORLDS[-1]}; there are "
        f"{known}{hint}"
    )


def _contradictions(
    stored: StoredSequence,
    steps: tuple[tuple[TransformName, bool], ...],
    sources: Mapping[TransformName, str],
    fixed: Mapping[TransformName, FloatArray],
) -> list[str]:
    """Transforms that are not taken although they lead between two frames of the way, and lead elsewhere."""
    used, notes = {name for name, _ in steps}, []
    for name in sorted(set(sources) - used):
        way = find_path(set(sources) - {name}, *name) or []
        names = [name, *(step for step, _ in way)]
        if not used & {*names} or (matrices := _together(stored, names, fixed)) is None:
            continue
        product = np.eye(4)
        for (_, is_inverted), matrix in zip(way, matrices[1:], strict=True):
            product = (_inverse(matrix) if is_inverted else matrix) @ product
        apart = float(np.linalg.norm((product - matrices[0])[:3, 3]))
        if apart > SAME_MM or not np.allclose(product, matrices[0], rtol=1e-3, atol=1e-3 + SAME_MM):
            notes.append(
                f"{'To'.join(name)} of {sources[name]} is left out: it is {apart:.3g} mm from the way that was taken"
            )
    return notes


def _together(
    stored: StoredSequence, names: list[TransformName], fixed: Mapping[TransformName, FloatArray]
) -> list[FloatArray] | None:
    """Transforms in the first frame in which all of them are valid; None where there is none."""
    for fields in stored.frame_fields:
        keys = ["To".join(name) for name in names]
        if all(
            name in fixed or (key + _TRANSFORM in fields and fields.get(key + _STATUS, "OK").upper() == "OK")
            for name, key in zip(names, keys, strict=True)
        ):
            try:
                return [
                    fixed[name] if name in fixed else parse_matrix(fields[key + _TRANSFORM], key)
                    for name, key in zip(names, keys, strict=True)
                ]
            except DatasetInvalid:
                continue
    return None


def _counted(left_out: Mapping[int, str]) -> str:
    return "; ".join(f"{reason} in {count}" for reason, count in Counter(left_out.values()).most_common(5))


def _measured(stored: StoredSequence, number: int, name: TransformName) -> FloatArray:  # [4, 4]
    key = "To".join(name)
    where = f"{stored.path}: frame {number}: {key}"
    matrix = parse_matrix(stored.frame_fields[number][key + _TRANSFORM], where)
    if any(part.endswith(IMAGE) for part in name):  # holds the size of a pixel
        return matrix
    try:
        exact: FloatArray = check_poses(matrix, field=key)[0]
        return exact
    except InvalidPose as error:
        raise DatasetInvalid(f"{stored.path}: frame {number}: {error}") from error


def _fan_of(
    stored: StoredSequence,
    device_set: DeviceSet | None,
    calibration: FloatArray | None,
    to_pixels: FloatArray,
    pixel_mm: tuple[float, float],
) -> tuple[FanGeometry | None, list[str]]:
    """The fan of the device set or of our own export, in stored pixels, and a note of it."""
    scale = np.abs(np.diag(to_pixels)[:2])
    if device_set is not None:
        found = fan_of_device_set(device_set, (pixel_mm[0] * scale[0], pixel_mm[1] * scale[1]))
        if found is not None:
            column, row, _, _ = to_pixels @ (found.apex_column, found.apex_row, 0.0, 1.0)
            found = replace(found, apex_column=float(column), apex_row=float(row))
            return found, [f"the fan of the device set was taken: {found.words}"]
    found = fan_of_export(stored.fields, calibration, stored.path)
    return found, [] if found is None else [f"the fan of the file was taken: {found.words}"]


def _clip_of(
    device_set: DeviceSet | None, to_pixels: FloatArray, size: tuple[int, int]
) -> tuple[CropBox | None, list[str]]:
    """The rectangle to which the device set clips the images of a volume, in stored pixels, and what is to be told."""
    found, notes = None, []
    for element, (left, top, width, height) in clip_rectangles(device_set) if device_set else ():
        edges = np.array([(left, left + width), (top, top + height), (0.5, 0.5), (1.5, 1.5)]) - 0.5
        ends = ((to_pixels @ edges)[:2] + 0.5).round().astype(int)
        ends = np.sort(ends, axis=1).clip(0, [[size[1]], [size[0]]])
        box, words = CropBox(*map(int, ends.ravel())), f"{ends[0][0]}:{ends[0][1]},{ends[1][0]}:{ends[1][1]}"
        is_whole = (box.width, box.height) == size[::-1]
        if box.width < 1 or box.height < 1:
            notes.append(f"the rectangle of {element} in the device set lies beyond the image: it is not taken")
        elif element == "VolumeReconstruction":
            if is_whole:
                continue
            found = box
            notes.append(f"the device set clips to columns and rows {words}: taken; --crop takes another part")
        elif not is_whole:
            notes.append(f"the rectangle of {element} in the device set is not taken: --crop {words} does")
    return found, notes


def _odd_lengths(
    stored: StoredSequence, calibration: FloatArray | None, pixel_mm: tuple[float, float]
) -> Iterator[str]:
    """Lengths of the file that contradict each other, or are in another unit than their neighbours."""
    spacing = [abs(float(word)) for word in re.findall(r"[-+.\deE]+", _field(stored, "ElementSpacing"))[:2]]
    if (
        len(spacing) == 2
        and spacing != [1.0, 1.0]
        and not np.allclose(sorted(spacing), sorted(pixel_mm), rtol=SAME_SPACING)
    ):
        yield (
            f"ElementSpacing says pixels of {spacing[0]:.4g} x {spacing[1]:.4g} mm, the calibration "
            f"{pixel_mm[0]:.4g} x {pixel_mm[1]:.4g}: this one is taken"
        )
    yield from near_sensor(calibration)


def _notes(
    stored: StoredSequence,
    numbers: np.ndarray,
    orientation: str,
    whole: tuple[int, int] | None,
    left_out: Mapping[int, str],
) -> list[str]:
    """`whole`: rows and columns of images that were neither cropped nor brought back from a fan."""
    notes = []
    if left_out:
        notes.append(
            f"frames without a valid pose or image were left out: {frame_list(sorted(left_out))} ({len(left_out)} in "
            f"all: {_counted(left_out)})"
        )
    if orientation in UNKNOWN:
        notes.append("the file does not say how its images are oriented: taken as MF, columns lateral, rows depth")
    if whole is not None:
        notes.append(f"no crop was given: the whole image of {whole[1]} x {whole[0]} pixels is taken as ultrasound")
    if named := sorted(key for key, value in stored.fields.items() if value and _PERSON.fullmatch(key)):
        notes.append(f"its header names a person ({', '.join(named)[:200]}): convert --anonymize leaves it out")
    for key in sorted({key for fields in stored.frame_fields for key in fields if _DEPTH.fullmatch(key)}):
        depths: dict[str, list[int]] = {}
        for number in numbers.tolist():
            depths.setdefault(stored.frame_fields[number].get(key, "unknown"), []).append(number)
        if len(depths) > 1:
            listing = "; ".join(f"{depth} in {frame_list(places)}" for depth, places in list(depths.items())[:5])
            raise DatasetInvalid(
                f"{stored.path}: {key} changes on the way: {listing}; choose frames of one depth with frames"
            )
    return notes
