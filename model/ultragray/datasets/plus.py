"""Sequences recorded with PLUS: tracked 2D images in MetaImage or NRRD files.

The pose of a frame follows from its transforms and the device set's calibration: from `Image` to `Reference` where that
is tracked, else to `Tracker`; usually inv(ReferenceToTracker) · ProbeToTracker · ImageToProbe.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ultragray.datasets.fan import (
    FanGeometry,
    FanLines,
    TransformName,
    fan_of_device_set,
    fan_of_export,
    find_path,
    parse_fan,
    parse_matrix,
    poses_of_fan,
    read_device_set,
    transform_name,
)
from ultragray.datasets.images import grey_frames, parse_crop, pixel_size_mm, poses_from_image_transforms, region_of
from ultragray.datasets.plus_files import UNKNOWN, StoredSequence, orient_frames, read_meta_image, read_nrrd
from ultragray.errors import DatasetInvalid, InvalidArgument, InvalidPose
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.sweep import Sweep, parse_frame_ranges

_READERS = {".mha": read_meta_image, ".mhd": read_meta_image, ".nrrd": read_nrrd, ".nhdr": read_nrrd}
IMAGE, WORLDS = "Image", ("Reference", "Tracker", "World")
_TRANSFORM, _STATUS = "Transform", "TransformStatus"
_IMAGE_STATUSES = ("ImageStatus", "Status")  # as MetaImage and NRRD sequences call it


def read_plus_sweep(
    path: Path,
    *,
    device_set: Path | None = None,
    frames: str | None = None,
    crop: str | None = None,
    fan: str | None = None,
    transform: str | None = None,
) -> tuple[Sweep, int]:
    """The frames of a sequence that have a valid pose, and the number of frames in the file.

    `frames` (ranges, `parse_frame_ranges`) chooses among them, `crop` is "columns,rows" of the image after it was
    brought to x lateral, y depth. `fan` (`parse_fan`), or without `crop` the fan of the device set or of our own
    export, says that the images are those of a convex or phased probe on a screen: the frames are its scan lines, the
    poses have their origin at the apex. `transform` names the tracked transform to take, such as ProbeToTracker, where
    there are several trackers: poses are then in the frame that it leads to. Transforms of the device set go before
    those of the same name in the sequence. Frames whose status is not OK are left out, and the sweep's notes say so; a
    sequence without statuses is taken to be valid. Raises DatasetInvalid, naming the file, the frame and the reason;
    InvalidArgument for options that do not fit.
    """
    if fan is not None and crop is not None:
        raise InvalidArgument("fan must be given without crop: it says where the image lies", field="fan")
    stored = _READERS[path.suffix.lower()](path)
    frame_count = len(stored.pixels)
    chosen = range(frame_count) if frames is None else parse_frame_ranges(frames, frame_count, option="frames")
    _check_image_type(stored)
    orientation = _field(stored, "UltrasoundImageOrientation").upper()
    known = None if device_set is None else read_device_set(device_set)
    fixed = {} if known is None else known.transforms
    way = _way_to_world(stored, fixed, device_set, transform)
    numbers, transforms = _image_transforms(stored, chosen, way, fixed)
    images = orient_frames(grey_frames(stored.pixels, str(path)), orientation, path)
    size = images.shape[1], images.shape[2]
    box = parse_crop(crop, *size)
    poses, linear = poses_from_image_transforms(transforms, box, numbers, path)
    probe: Probe = linear
    pixel_mm = pixel_size_mm(transforms)
    calibration = _calibration(stored, fixed)
    whole = crop is None and fan is None
    geometry, origin = None if fan is None else parse_fan(fan), ""
    if whole and known is not None:
        geometry, origin = fan_of_device_set(known, pixel_mm), "device set"
    if whole and geometry is None:
        geometry, origin = fan_of_export(stored.fields, calibration, path), "file"
    if geometry is None:
        shown = images[numbers, box.top : box.bottom, box.left : box.right]
        fan_notes = []
    else:
        lines = FanLines(geometry, size, pixel_mm)
        shown, box, probe = lines.frames(images[numbers]), lines.box, geometry.probe()
        poses = poses_of_fan(poses, geometry, size[1], pixel_mm)
        fan_notes = _fan_notes(geometry, lines, origin)
    left_out = sorted(set(chosen) - set(numbers.tolist()))
    sweep = Sweep(
        images=np.ascontiguousarray(shown),
        poses=poses,
        probe=probe,
        frame_numbers=numbers,
        source=str(path),
        region=region_of(size, box, pixel_mm, calibration),
        notes=(*stored.notes, *_notes(orientation, size if whole and geometry is None else None, left_out), *fan_notes),
    )
    return sweep, frame_count


def _calibration(stored: StoredSequence, fixed: Mapping[TransformName, FloatArray]) -> FloatArray | None:  # [4, 4]
    """ImageToProbe as it was used, of the first frame where the sequence has it."""
    if (matrix := fixed.get((IMAGE, "Probe"))) is not None:
        return matrix
    text = next((fields[key] for fields in stored.frame_fields if (key := f"{IMAGE}ToProbe{_TRANSFORM}") in fields), "")
    return parse_matrix(text, f"{stored.path}: {IMAGE}ToProbe") if text else None


def _field(stored: StoredSequence, name: str) -> str:
    """A field of the file; NRRD sequences write `ultrasound image orientation`."""
    for key, value in stored.fields.items():
        if key.replace(" ", "").lower() == name.lower():
            return value
    return ""


def _check_image_type(stored: StoredSequence) -> None:
    kind = _field(stored, "UltrasoundImageType").upper()
    if kind not in ("", "XX", "BRIGHTNESS", "RGB_COLOR"):
        raise DatasetInvalid(f"{stored.path}: images must be B-mode (BRIGHTNESS or RGB_COLOR), got {kind[:40]}")


def _way_to_world(
    stored: StoredSequence,
    fixed: Mapping[TransformName, FloatArray],
    device_set: Path | None,
    transform: str | None,
) -> list[tuple[TransformName, bool]]:
    """The transforms from Image to the frame that poses are given in, by name: the same for every frame."""
    names = {
        name
        for fields in stored.frame_fields
        for key in fields
        if key.endswith(_TRANSFORM) and (name := transform_name(key.removesuffix(_TRANSFORM)))
    }
    known = ", ".join(sorted("To".join(name) for name in {*names, *fixed})) or "none"
    if transform is not None:
        wanted = transform_name(transform)
        if wanted is None or wanted not in {*names, *fixed}:
            raise InvalidArgument(
                f"transform must be one of the sequence, such as ProbeToTracker; there are {known}, got "
                f"{transform[:80]!r}",
                field="transform",
            )
        others = {*names, *fixed} - {wanted}
        before = find_path(others, IMAGE, wanted[0])
        if before is None:
            raise DatasetInvalid(f"{stored.path}: no transforms lead from {IMAGE} to {wanted[0]}; there are {known}")
        return [*before, (wanted, False)]
    for world in WORLDS:
        way = find_path([*names, *fixed], IMAGE, world)
        if way is not None:
            return way
    hint = "" if device_set else " (give the device set that holds ImageToProbe)"
    raise DatasetInvalid(
        f"{stored.path}: no transforms lead from {IMAGE} to {', '.join(WORLDS[:-1])} or {WORLDS[-1]}; there are {known}"
        f"{hint}"
    )


def _image_transforms(
    stored: StoredSequence,
    chosen: range | list[int],
    way: list[tuple[TransformName, bool]],
    fixed: Mapping[TransformName, FloatArray],
) -> tuple[np.ndarray, FloatArray]:  # [F], [F, 4, 4]
    """Numbers of the chosen frames that are valid, and their transforms from pixels to the world."""
    valid = [number for number in chosen if _is_valid(stored.frame_fields[number], way, fixed)]
    if not valid:
        raise DatasetInvalid(
            f"{stored.path}: none of its {len(chosen)} frames has a valid {_tracked(way, fixed)}: "
            "every status is other than OK, or the transforms are missing"
        )
    transforms = np.tile(np.eye(4), (len(valid), 1, 1))
    for place, number in enumerate(valid):
        for name, inverted in way:
            step = fixed[name] if name in fixed else _measured(stored, number, name)
            transforms[place] = (np.linalg.inv(step) if inverted else step) @ transforms[place]
    return np.array(valid, np.int64), transforms


def _is_valid(
    fields: Mapping[str, str], way: list[tuple[TransformName, bool]], fixed: Mapping[TransformName, FloatArray]
) -> bool:
    statuses = [fields.get(key, "OK") for key in _IMAGE_STATUSES]
    for name, _ in way:
        if name not in fixed:
            key = "To".join(name)
            statuses.append(fields.get(key + _STATUS, "OK") if key + _TRANSFORM in fields else "MISSING")
    return all(status.upper() == "OK" for status in statuses)


def _measured(stored: StoredSequence, number: int, name: TransformName) -> FloatArray:  # [4, 4]
    key = "To".join(name)
    where = f"{stored.path}: frame {number}: {key}"
    matrix = parse_matrix(stored.frame_fields[number][key + _TRANSFORM], where)
    if IMAGE in name:  # holds the size of a pixel
        return matrix
    try:
        exact: FloatArray = check_poses(matrix, field=key)[0]
        return exact
    except InvalidPose as error:
        raise DatasetInvalid(f"{stored.path}: frame {number}: {error}") from error


def _tracked(way: list[tuple[TransformName, bool]], fixed: Mapping[TransformName, FloatArray]) -> str:
    return " and ".join("To".join(name) for name, _ in way if name not in fixed) or "image"


def _fan_notes(fan: FanGeometry, lines: FanLines, origin: str) -> list[str]:
    """`origin`: where the fan was found; empty: it was given."""
    notes = [f"the fan of the {origin} was taken: {fan.words}"] if origin else []
    if lines.share < 1.0 - 1e-3:
        notes.append(f"{1.0 - lines.share:.1%} of the fan lies beyond the image and is black")
    return notes


def _notes(orientation: str, whole: tuple[int, int] | None, left_out: list[int]) -> list[str]:
    """`whole`: rows and columns of images that were neither cropped nor brought back from a fan."""
    notes = []
    if left_out:
        listed = ", ".join(map(str, left_out[:10])) + (", …" if len(left_out) > 10 else "")
        notes.append(f"frames without a valid pose or image were left out: {listed} ({len(left_out)} in all)")
    if orientation in UNKNOWN:
        notes.append("the file does not say how its images are oriented: taken as MF, columns lateral, rows depth")
    if whole is not None:
        notes.append(f"no crop was given: the whole image of {whole[1]} x {whole[0]} pixels is taken as ultrasound")
    return notes
