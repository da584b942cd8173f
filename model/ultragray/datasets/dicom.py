"""DICOM cine loops: a multi-frame ultrasound image (.dcm), and the poses of its frames beside it.

`sweep.dcm` goes with `sweep.poses.npy` or `sweep.poses.json`: one pose for each frame, probe→tracker, mm, whose origin
is the top centre of the region that shows the image (SequenceOfUltrasoundRegions, PS3.3 C.8.5.5), x along its rows of
pixels, z down its columns. Of a convex or phased probe, whose fan on the screen is said in words, the origin is the
apex, z the middle of the fan. Where a file has no regions, the whole image is the region and PixelSpacing its scale.
Files of our own exporter hold their probe, its geometry and the poses themselves. The extra `dicom`.
"""

from __future__ import annotations

import io
import json
import math
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ultragray.contract import from_dict
from ultragray.datasets.clocks import delay_note, parse_delay_ns, poses_before
from ultragray.datasets.fan import parse_fan, tracked_sweep
from ultragray.datasets.image_geometry import ImageGeometry, PixelGrid
from ultragray.datasets.images import (
    MAX_PIXEL_BYTES,
    CropBox,
    check_pixel_mm,
    grey_frames,
    parse_crop,
)
from ultragray.datasets.released import no_pose_note
from ultragray.errors import DatasetInvalid, InvalidArgument, InvalidPose
from ultragray.exchange.poses import frames_with_pose, read_frame_poses
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.installation import missing_extra
from ultragray.learn.sweep import ByteArray, Chain, IntArray, Link, Sweep, check_frame_poses, parse_frame_ranges
from ultragray.rendering.display import Display

POSE_SUFFIXES = (".poses.npy", ".poses.json")
MAX_HEADER_BYTES = 16 << 20  # of all that stands before the pixels
DEFLATED = "1.2.840.10008.1.2.1.99"  # the whole data set is compressed: it could inflate without bounds
VIDEO = "1.2.840.10008.1.2.4.10"  # MPEG-2, MPEG-4 and HEVC: what these numbers begin with
JPEG = ("1.2.840.10008.1.2.4.50", "1.2.840.10008.1.2.4.51")  # baseline, extended
CENTIMETRES, TISSUE_2D, TISSUE = 3, 1, 1
GREY, RGB, YBR = (
    ("MONOCHROME1", "MONOCHROME2", "PALETTE COLOR"),
    ("RGB", "YBR_ICT", "YBR_RCT"),  # decoders of JPEG 2000 undo the two transforms
    ("YBR_FULL", "YBR_FULL_422"),
)
INTERPRETATIONS = {**dict.fromkeys(GREY, 1), **dict.fromkeys((*RGB, *YBR), 3)}  # samples of a pixel
PERSON = ("PatientName", "PatientID", "PatientBirthDate", "OtherPatientIDs", "AccessionNumber")
NOBODY = re.compile(r"(?i)\W*|.*(anon|unknown|phantom|test|simulated|ultragray).*")
GREY_LEVELS = 10  # by which the samples of a grey pixel may differ: of lossy JPEG they do
OTHER = 0.02  # relative, by which two sizes of a pixel may differ
UNUSED_BITS = 3  # which a scanner that says how many bits it stores does not leave
LEAST_GREY = 0.25  # of the pixels of ultrasound beside its flow; read wrongly, less than half of them stay grey


def read_dicom_sweep(
    path: Path,
    *,
    frames: str | None = None,
    crop: str | None = None,
    fan: str | None = None,
    image_delay_ms: str | None = None,
) -> tuple[Sweep, int]:
    """The frames of a cine loop that have a pose, and the number of frames in the file.

    `frames` (ranges, `parse_frame_ranges`) chooses among them; `crop` is "columns,rows" of the stored image, default:
    the region; of several regions it chooses that which holds it. `fan` (`parse_fan`) says that the image is that of a
    convex or phased probe: the frames are its scan lines. `image_delay_ms` is by how much the images come later than
    the poses. Colour becomes luma. Raises DatasetInvalid, naming the file, the frame and the reason; InvalidArgument
    for options that do not fit; ExtraMissing without pydicom.
    """
    delay_ns = parse_delay_ns(image_delay_ms)
    header = _read_header(path)
    own = _OwnExport.of(path, header)
    if own is not None and fan is not None:
        raise InvalidArgument(f"fan is not for {path.name}: it says its {own.probe} itself", field="fan")
    shape = _shape(path, header, is_fan=fan is not None or own is not None)
    if own is None:
        region, notes = _region(path, header, shape, crop)
        poses, poses_path = _read_poses(path, shape[0])
    else:
        poses, poses_path, notes = own.poses_of(path, shape[0]), path, own.notes(path)
    numbers = np.flatnonzero(frames_with_pose(poses))
    times_s = _times(path, header, shape[0], is_rendered=own is not None)
    notes += no_pose_note(numbers, shape[0], poses_path)
    poses = check_frame_poses(poses[numbers], numbers, str(poses_path))
    if delay_ns:
        poses, known = poses_before(poses, None if times_s is None else times_s[numbers], delay_ns, path)
        poses, numbers = poses[known], numbers[known]
    if frames is not None:
        is_chosen = np.isin(numbers, parse_frame_ranges(frames, shape[0], option="frames"))
        poses, numbers = poses[is_chosen], numbers[is_chosen]
    if not len(numbers):
        raise DatasetInvalid(f"{path}: none of its frames that were chosen has a pose in {poses_path.name}")
    stored, pixel_notes = _read_frames(path, header, shape, numbers)
    notes += (*pixel_notes, *_header_notes(path, header, is_own=own is not None), *delay_note(delay_ns))
    chosen_s = None if times_s is None else times_s[numbers]
    if own is not None:
        return own.sweep(stored, poses, numbers, path, notes, crop, chosen_s), shape[0]
    chain = Chain(
        (
            Link("pixels", "region", region.source, path.name),
            Link("region", "Tracker", "pose", poses_path.name, is_tracked=True),
        )
    )
    lateral_mm, axial_mm = region.pixel_mm
    if fan is None:
        column, row = (region.box.left + region.box.right - 1) / 2, region.box.top - 0.5
        crop = crop or region.crop
    else:
        geometry = parse_fan(fan)
        column, row = geometry.apex_column, geometry.apex_row
    image_to_probe = np.array(
        [
            [lateral_mm, 0.0, 0.0, -lateral_mm * column],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, axial_mm, 0.0, -axial_mm * row],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    sweep = tracked_sweep(
        stored,
        poses,
        image_to_probe,
        numbers,
        path,
        crop=crop,
        fan=fan,
        calibration=f"{path}: {region.source}",
        chain=chain,
        notes=notes,
        times_s=chosen_s,
    )
    return sweep, shape[0]


def _times(path: Path, header: Any, count: int, *, is_rendered: bool) -> FloatArray | None:  # [F] s
    """The times of the frames; None where the file does not say them. The step of rendered ones is for viewers."""
    with _in_our_words(path):
        vector = header.get("FrameTimeVector")
        if vector is not None and len(vector) == count:
            return np.cumsum([0.0, *map(float, vector[1:])]) / 1000
        step_ms = None if is_rendered else header.get("FrameTime")
        return np.arange(count) * float(step_ms) / 1000 if step_ms and float(step_ms) > 0 else None


def _header_notes(path: Path, header: Any, *, is_own: bool) -> tuple[str, ...]:
    with _in_our_words(path):
        named = [name for name in PERSON if not NOBODY.fullmatch(str(header.get(name, "")))]
        is_burnt_in = str(header.get("BurnedInAnnotation", "")).upper() == "YES"
        slope, intercept = (float(header.get(f"Rescale{name}", one)) for name, one in (("Slope", 1), ("Intercept", 0)))
    is_rescaled = (slope, intercept) != (1.0, 0.0)
    is_unnamed = not is_own and _transducer(path, header) is None
    burnt_in = "annotations are burnt into its pixels" if is_own else "its pixels name a person: crop them"
    notes = (
        "the file does not name its transducer: taken as a linear one" if is_unnamed else "",
        f"its values are stored times {slope:g} plus {intercept:g}: taken as stored" if is_rescaled else "",
        f"its header names a person ({', '.join(named)}): convert --anonymize leaves it out" if named else "",
        f"{burnt_in} (BurnedInAnnotation YES)" if is_burnt_in else "",
    )
    return tuple(note for note in notes if note)


@contextmanager
def _in_our_words(where: Path | str) -> Iterator[None]:
    """Turns every error of pydicom about a file into DatasetInvalid, and leaves its warnings out."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (DatasetInvalid, MemoryError):
        raise
    except ImportError as error:
        raise missing_extra(error, "DICOM") from None
    except Exception as error:
        raise DatasetInvalid(f"{where}: it cannot be read as DICOM: {error}") from error


class _BoundedFile(io.FileIO):
    """Reads no more than a header may hold."""

    left = MAX_HEADER_BYTES

    def read(self, size: int | None = -1, /) -> bytes:
        most = self.left + 1
        data = super().read(most if size is None or size < 0 else min(size, most)) or b""
        self.left -= len(data)
        if self.left < 0:
            raise DatasetInvalid(f"{self.name}: over {MAX_HEADER_BYTES >> 20} MiB stand before its pixels")
        return data


def _read_header(path: Path) -> Any:
    """The data set without its pixels."""
    with _in_our_words(path):
        import pydicom
        from pydicom.filereader import read_file_meta_info

        syntax = read_file_meta_info(path).get("TransferSyntaxUID", "")
        if syntax.startswith(VIDEO):
            raise DatasetInvalid(
                f"{path}: its pixels are a video ({syntax.name}), which is not read: write its frames as pictures "
                "beside a poses.csv"
            )
        if syntax == DEFLATED:
            raise DatasetInvalid(f"{path}: its data set is deflated, which is not read: save it in another syntax")
        with _BoundedFile(path) as file:
            return pydicom.dcmread(file, stop_before_pixels=True)


@dataclass(frozen=True)
class _OwnExport:
    """What a file of our own exporter says of itself: its private elements, and its one region."""

    probe: Probe
    picture: PixelGrid
    box: CropBox  # of the picture in the image: annotations may stand below it
    stored_poses: bytes

    @classmethod
    def of(cls, path: Path, header: Any) -> _OwnExport | None:
        """None of other files. Raises DatasetInvalid for elements that cannot be read."""
        with _in_our_words(path):
            from ultragray.exchange.exports.dicom import (
                ORIGIN_ELEMENT,
                POSES_ELEMENT,
                PRIVATE_CREATOR,
                PRIVATE_GROUP,
            )

            try:
                block = header.private_block(PRIVATE_GROUP, PRIVATE_CREATOR)
                poses, text = block[POSES_ELEMENT].value, block[ORIGIN_ELEMENT].value
            except KeyError:
                return None
            origin, regions = json.loads(text), header.get("SequenceOfUltrasoundRegions", [])
            if len(regions) != 1 or not _is_tissue(regions[0]):
                raise DatasetInvalid(f"{path}: our own export must have one region in centimetres, got {len(regions)}")
            probe, depth_mm = from_dict(Probe, origin["probe"]), from_dict(Display, origin["display"]).depth_mm
            if depth_mm is not None:
                probe = probe.ending_at(min(probe.far_mm, probe.face_depth_mm + depth_mm))
            column, row = (10.0 * float(regions[0][f"ReferencePixelPhysicalValue{axis}"].value) for axis in "XY")
            region = _read_region(path, regions[0])
            return cls(probe, PixelGrid("mm", column, row, *region.pixel_mm), region.box, poses)

    def poses_of(self, path: Path, count: int) -> FloatArray:  # [F, 4, 4]
        """Raises DatasetInvalid where there are not as many as frames."""
        expected = 16 * 8 * count
        if len(self.stored_poses) != expected:
            raise DatasetInvalid(
                f"{path}: poses of {count} frames must have {expected} bytes, its private element has "
                f"{len(self.stored_poses)}"
            )
        return np.frombuffer(self.stored_poses, "<f8").reshape(-1, 4, 4).astype(np.float64)

    def notes(self, path: Path) -> tuple[str, ...]:
        beside = ", ".join(one.name for one in _poses_beside(path))
        return (f"{beside} beside the file is not read: it holds its poses itself",) if beside else ()

    def sweep(
        self,
        images: ByteArray,  # [F, rows, columns]
        poses: FloatArray,  # [F, 4, 4] mm
        numbers: IntArray,
        path: Path,
        notes: tuple[str, ...],
        crop: str | None,
        times_s: FloatArray | None,  # [F]
    ) -> Sweep:
        inner = images[:, self.box.top : self.box.bottom, self.box.left : self.box.right]
        sweep = ImageGeometry(self.probe, self.picture).sweep(inner, poses, numbers, path, notes, crop, times_s)
        return replace(sweep, chain=Chain((Link("Probe", "Tracker", "pose", path.name, is_tracked=True),)))


def _value(path: Path, header: Any, name: str) -> Any:
    with _in_our_words(path):  # pydicom reads a value when it is first asked for
        value = header.get(name)
    if value is None or value == "":
        raise DatasetInvalid(f"{path}: it lacks {name}")
    return value


def _shape(path: Path, header: Any, *, is_fan: bool) -> tuple[int, int, int]:  # frames, rows, columns
    """The size of the frames. Raises DatasetInvalid for what is no cine loop of 8 bits in grey or colour, and for a
    probe that is not linear unless its fan is known."""
    bits, interpretation = _value(path, header, "BitsAllocated"), str(_value(path, header, "PhotometricInterpretation"))
    with _in_our_words(path):
        stored = int(header.get("BitsStored", 8))
        high = int(header.get("HighBit", stored - 1))
        is_signed = header.get("PixelRepresentation", 0) != 0
    if bits not in (8, 16) or is_signed:
        raise DatasetInvalid(
            f"{path}: pixels must have 8 or 16 bits (BitsAllocated) without a sign, got {str(bits)[:40]}"
        )
    samples = _value(path, header, "SamplesPerPixel")
    if high != stored - 1:
        raise DatasetInvalid(f"{path}: HighBit must be BitsStored - 1, {stored - 1}, got {high}")
    if INTERPRETATIONS.get(interpretation) != samples or not 1 <= stored <= bits:
        raise DatasetInvalid(
            f"{path}: PhotometricInterpretation must be {', '.join(INTERPRETATIONS)} with SamplesPerPixel 1 or 3, got "
            f"{interpretation[:40]} with {str(samples)[:40]}"
        )
    transducer = _transducer(path, header)
    if transducer not in ("LINEAR", "", None) and not is_fan:
        raise DatasetInvalid(
            f"{path}: the probe is not linear, TransducerType is {transducer[:40]}: say with fan where it lies on the "
            "screen"
        )
    names = ("NumberOfFrames", "Rows", "Columns")
    with _in_our_words(path):
        frames, rows, columns = (int(_value(path, header, name)) for name in names)
    if min(frames, rows, columns) < 1 or frames * rows * columns * int(samples) * bits // 8 > MAX_PIXEL_BYTES:
        raise DatasetInvalid(
            f"{path}: it must have 1 to {MAX_PIXEL_BYTES:,} bytes of pixels, its header says {frames} x {rows} x "
            f"{columns}"
        )
    return frames, rows, columns


def _transducer(path: Path, header: Any) -> str | None:
    """TransducerType, or of an enhanced volume the meaning of its code; None where the file says neither."""
    with _in_our_words(path):
        if (kind := header.get("TransducerType")) is not None:
            return str(kind)
        for code in header.get("TransducerGeometryCodeSequence", []):
            meaning = str(code.get("CodeMeaning", "")).upper()
            return "LINEAR" if meaning.startswith("LINEAR") else meaning
    return None


@dataclass(frozen=True)
class _Region:
    """A part of the image that shows ultrasound, and the lateral and axial size of its pixels, mm."""

    box: CropBox
    pixel_mm: tuple[float, float]
    source: str

    @property
    def crop(self) -> str:
        """As the option `crop` names it."""
        return f"{self.box.left}:{self.box.right},{self.box.top}:{self.box.bottom}"


def _region(path: Path, header: Any, shape: tuple[int, int, int], crop: str | None) -> tuple[_Region, tuple[str, ...]]:
    """The region that shows ultrasound, that of several which holds the crop, and what is to be told of it."""
    _, rows, columns = shape
    with _in_our_words(path):
        regions = [one for one in header.get("SequenceOfUltrasoundRegions", []) if _is_tissue(one)]
        echoes = [one for one in regions if one.get("RegionDataType") == TISSUE]
        found = list(dict.fromkeys(_read_region(path, one) for one in echoes or regions))
        spacing = _pixel_spacing(header)
        notes = _other_sizes(header, found, spacing)
        if not found:
            if spacing is None:
                raise DatasetInvalid(
                    f"{path}: it does not say how large a pixel is: no region of SequenceOfUltrasoundRegions in "
                    "centimetres, and no PixelSpacing"
                )
            found = [_Region(CropBox(0, columns, 0, rows), spacing, "PixelSpacing")]
            if crop is None:
                notes += (
                    f"no region in centimetres: the whole image of {columns} x {rows} pixels is taken as ultrasound",
                )
    if len(found) > 1:
        listed = "; ".join(
            f"{one.crop} (pixels of {one.pixel_mm[0]:.4g} x {one.pixel_mm[1]:.4g} mm)" for one in found[:8]
        )
        box = None if crop is None else parse_crop(crop, rows, columns)
        found = [] if box is None else [one for one in found if _holds(one.box, box)]
        if len(found) != 1:
            raise DatasetInvalid(f"{path}: it has several regions that show a plane, choose one with crop: {listed}")
    (region,) = found
    check_pixel_mm(region.pixel_mm, min(rows, columns), f"{path}: {region.source}")
    box = region.box
    clipped = CropBox(box.left, min(box.right, columns), box.top, min(box.bottom, rows))
    beyond = max(box.right - columns, box.bottom - rows, -box.left, -box.top)
    if clipped.width < 1 or clipped.height < 1 or (beyond > 1 and crop is None):
        raise DatasetInvalid(
            f"{path}: its region, columns and rows {region.crop}, does not lie within {columns} x {rows} pixels: say "
            "with crop which part to take"
        )
    if beyond != 1:
        return region, notes
    note = f"its region, columns and rows {region.crop}, ends one pixel beyond the image: clipped by that pixel"
    return replace(region, box=clipped), (*notes, note)


def _pixel_spacing(header: Any) -> tuple[float, float] | None:
    """Lateral and axial size of a pixel, mm; of an enhanced file among the measures that its frames share."""
    shared: Any = next(iter(header.get("SharedFunctionalGroupsSequence", [])), {})
    measures: Any = next(iter(shared.get("PixelMeasuresSequence", [])), {})
    spacing = header.get("PixelSpacing") or measures.get("PixelSpacing")
    return (float(spacing[1]), float(spacing[0])) if spacing else None


def _other_sizes(header: Any, regions: list[_Region], spacing: tuple[float, float] | None) -> tuple[str, ...]:
    """What else the file says of lengths, where its regions say otherwise."""
    sizes = " or ".join(f"{one.pixel_mm[0]:.4g} x {one.pixel_mm[1]:.4g}" for one in regions)
    found = []
    if spacing and regions and not any(np.allclose(one.pixel_mm, spacing, rtol=OTHER) for one in regions):
        found.append(
            f"PixelSpacing says pixels of {spacing[0]:.4g} x {spacing[1]:.4g} mm, its regions {sizes}: these count"
        )
    depth_mm = float(header.get("DepthOfScanField") or 0.0)
    depths_mm = [one.box.height * one.pixel_mm[1] for one in regions]
    if depth_mm and depths_mm and not any(depth_mm / 2 < one < depth_mm * 2 for one in depths_mm):
        found.append(
            f"the file says that it sees {depth_mm:g} mm deep (DepthOfScanField), its region is {depths_mm[0]:.4g} mm "
            "high: a length in another unit?"
        )
    return tuple(found)


def _holds(outer: CropBox, inner: CropBox) -> bool:
    return (
        outer.left <= inner.left
        and inner.right <= outer.right
        and outer.top <= inner.top
        and inner.bottom <= outer.bottom
    )


def _read_region(path: Path, region: Any) -> _Region:
    left, top, right, bottom = (
        int(_value(path, region, f"RegionLocation{name}")) for name in ("MinX0", "MinY0", "MaxX1", "MaxY1")
    )
    lateral_mm, axial_mm = (10.0 * float(_value(path, region, f"PhysicalDelta{axis}")) for axis in "XY")
    box = CropBox(left, right + 1, top, bottom + 1)
    return _Region(box, (lateral_mm, axial_mm), "SequenceOfUltrasoundRegions")


def _is_tissue(region: Any) -> bool:
    units = (region.get("PhysicalUnitsXDirection"), region.get("PhysicalUnitsYDirection"))
    return region.get("RegionSpatialFormat") == TISSUE_2D and units == (CENTIMETRES, CENTIMETRES)


def _poses_beside(path: Path) -> list[Path]:
    named = (path.with_name(f"{path.stem}{suffix}") for suffix in POSE_SUFFIXES)
    return [file for file in named if file.is_file()]


def _read_poses(path: Path, count: int) -> tuple[FloatArray, Path]:  # [F, 4, 4]
    """The poses of all frames, NaN of those without one, and their file."""
    found = _poses_beside(path)
    if len(found) != 1:
        wanted = " or ".join(f"{path.stem}{suffix}" for suffix in POSE_SUFFIXES)
        raise DatasetInvalid(f"{path}: the poses of its frames must lie beside it in {wanted}, found {len(found)}")
    try:
        poses = read_frame_poses(found[0])
    except InvalidPose as error:
        raise DatasetInvalid(error.detail) from error
    if poses.dtype.kind not in "fiu" or poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise DatasetInvalid(
            f"{found[0]}: poses must be numbers [N, 4, 4] or [N, 3, 4], got {poses.dtype} {list(poses.shape)}"
        )
    if len(poses) != count:
        raise DatasetInvalid(f"{path} holds {count} frames, but {found[0]} {len(poses)} poses")
    return np.array(poses, np.float64), found[0]


def _read_frames(
    path: Path, header: Any, shape: tuple[int, int, int], chosen: IntArray
) -> tuple[ByteArray, tuple[str, ...]]:
    """The chosen frames [C, rows, columns], decoded one at a time, and notes; colours become their luma."""
    interpretation, bits = str(header.PhotometricInterpretation), int(header.get("BitsStored", 8))
    is_wide = bits > 8 and interpretation in GREY[:2]
    frames = np.empty((len(chosen), *shape[1:]), np.uint16 if is_wide else np.uint8)
    with _in_our_words(path):
        syntax = header.file_meta.TransferSyntaxUID
    if syntax in JPEG and bits == 8 and interpretation != "PALETTE COLOR":
        return _read_jpeg(path, header, shape, chosen)
    notes: tuple[str, ...] = ()
    with _in_our_words(path):
        from pydicom.pixels import apply_color_lut, convert_color_space, get_decoder, iter_pixels

        try:
            decoder = get_decoder(syntax) if syntax.is_compressed else None
        except NotImplementedError:
            raise DatasetInvalid(f"{path}: pixels compressed as {syntax.name} cannot be read") from None
        if decoder is not None and not decoder.is_available:
            is_for_gdcm = any("gdcm" in one for one in decoder.missing_dependencies)
            advice = "install python-gdcm" if is_for_gdcm else "save the file without compression"
            raise DatasetInvalid(f"{path}: pixels compressed as {syntax.name} cannot be read: {advice}")
        surplus = max(0, bits - 8)
        if decoder is not None and syntax in JPEG and surplus and "pylibjpeg" not in decoder.available_plugins:
            raise DatasetInvalid(
                f"{path}: {bits} bits compressed as {syntax.name} cannot be read: install "
                "pylibjpeg-libjpeg (GPL), or save the file without compression"
            )
        is_shared = decoder is None and interpretation == "YBR_FULL_422" and path.stat().st_size < 3 * math.prod(shape)
        if is_shared:  # pydicom seeks other frames of these
            pixels = _shared_colours(path, shape, chosen)
        else:
            pixels = iter_pixels(path, indices=[int(number) for number in chosen], raw=True)
        is_ybr = interpretation in YBR
        for number, out in zip(chosen, frames, strict=True):
            with _in_our_words(f"{path}: frame {number}"):
                frame = next(pixels)
                if interpretation == "PALETTE COLOR":
                    frame = apply_color_lut(frame, header)
                    surplus = 8 * (frame.dtype.itemsize - 1)
            expected = out.shape if interpretation in GREY[:2] else (*out.shape, 3)
            if frame.shape != expected or frame.dtype.kind != "u":
                raise DatasetInvalid(
                    f"{path}: frame {number} must be unsigned {list(expected)}, got {frame.dtype} {list(frame.shape)}"
                )
            if is_wide:
                np.bitwise_and(frame, (1 << bits) - 1, out=out, casting="same_kind")
                continue
            frame = np.asarray(frame >> surplus if surplus else frame, np.uint8)
            if number == chosen[0] and frame.ndim == 3 and interpretation != "PALETTE COLOR":
                as_ybr = convert_color_space(frame, "YBR_FULL", "RGB")
                if _is_otherwise(*((as_ybr, frame) if is_ybr else (frame, as_ybr))):
                    is_ybr = not is_ybr
                    notes = (_other_colours(interpretation, "YBR_FULL" if is_ybr else "RGB"),)
            frame = convert_color_space(frame, "YBR_FULL", "RGB") if is_ybr else frame
            out[:] = grey_frames(frame[None], str(path))[0]
    if is_wide and (used := int(frames.max()).bit_length()) <= bits - UNUSED_BITS:
        notes, surplus = (f"only {used} of the {bits} bits of its pixels are used",), max(0, used - 8)
    if surplus:
        what, bits = ("colours", 8 + surplus) if interpretation == "PALETTE COLOR" else ("pixels", bits)
        notes = (*notes, f"{what} of {bits} bits were made 8: {(256 << surplus) - 1} became 255")
    grey = (frames >> surplus).astype(np.uint8) if is_wide else frames
    return 255 - grey if interpretation == "MONOCHROME1" else grey, notes


def _shared_colours(path: Path, shape: tuple[int, int, int], chosen: IntArray) -> Iterator[ByteArray]:
    """Uncompressed frames [rows, columns, 3] of YBR_FULL_422: two pixels, then the colours of both (PS3.3 C.7.6.3.1.2).

    Raises DatasetInvalid for an odd number of columns and where the file ends before.
    """
    import pydicom

    _, rows, columns = shape
    with path.open("rb") as file:
        header = pydicom.dcmread(file, stop_before_pixels=True)
        begin = file.tell() + (8 if header.file_meta.TransferSyntaxUID.is_implicit_VR else 12)
        for number in chosen:
            file.seek(begin + 2 * int(number) * rows * columns)
            data = file.read(2 * rows * columns)
            if len(data) < 2 * rows * columns or columns % 2:
                raise DatasetInvalid(f"{path}: frame {number}: truncated, or with half of a pair of pixels")
            pairs = np.frombuffer(data, np.uint8).reshape(rows, columns // 2, 4)
            frame = np.empty((rows, columns, 3), np.uint8)
            frame[:, 0::2, 0], frame[:, 1::2, 0] = pairs[..., 0], pairs[..., 1]
            frame[:, 0::2, 1:] = frame[:, 1::2, 1:] = pairs[..., 2:]
            yield frame


def _is_otherwise(as_said: ByteArray, as_other: ByteArray) -> bool:  # [rows, columns, 3]
    """Whether an image is grey, as ultrasound mostly is, where it is read otherwise than its header says."""
    own, other = (float((np.ptp(one, axis=2) <= GREY_LEVELS).mean()) for one in (as_said, as_other))
    return other > LEAST_GREY and own < other / 2


def _other_colours(header: str, pixels: str) -> str:
    return f"the header says {header}, the pixels are {pixels}: read as they are"


def _read_jpeg(
    path: Path, header: Any, shape: tuple[int, int, int], chosen: IntArray
) -> tuple[ByteArray, tuple[str, ...]]:
    """Frames of JPEG streams of 8 bits, whose own markers say what their colours are.

    Colours are decoded before their luma is taken: the stream's own luma is that of colours that no screen shows.
    """
    frames, places = np.empty((len(chosen), *shape[1:]), np.uint8), {int(one): at for at, one in enumerate(chosen)}
    interpretation, is_rgb = str(header.PhotometricInterpretation), False
    is_colour = INTERPRETATIONS[interpretation] == 3
    notes: tuple[str, ...] = ()
    flags = cv2.IMREAD_IGNORE_ORIENTATION | (cv2.IMREAD_COLOR_RGB if is_colour else cv2.IMREAD_GRAYSCALE)
    with _in_our_words(path), path.open("rb") as file:
        import pydicom
        from pydicom.encaps import generate_frames

        pydicom.dcmread(file, stop_before_pixels=True)
        file.seek(12, io.SEEK_CUR)  # tag, VR and length of the pixels
        streams = generate_frames(file, number_of_frames=shape[0])
        for number in range(int(chosen[-1]) + 1):
            with _in_our_words(f"{path}: frame {number}"):
                stream = next(streams)
            if number not in places:
                continue
            if number == chosen[0] and is_colour:
                is_rgb, notes = _jpeg_colours(stream, interpretation)
            size = re.search(rb"\xff[\xc0-\xc3]...(..)(..)", stream, re.DOTALL)  # never more than the header says
            frame = None
            if size is not None and tuple(int.from_bytes(side, "big") for side in size.groups()) == shape[1:]:
                frame = cv2.imdecode(np.frombuffer(_as_rgb(stream) if is_rgb else stream, np.uint8), flags)
            if frame is None or frame.shape[:2] != shape[1:]:
                raise DatasetInvalid(
                    f"{path}: frame {number}: it cannot be read as JPEG of {shape[2]} x {shape[1]} pixels"
                )
            frame = grey_frames(frame[None], str(path))[0]
            frames[places[number]] = 255 - frame if interpretation == "MONOCHROME1" else frame
    return frames, notes


def _jpeg_colours(stream: bytes, interpretation: str) -> tuple[bool, tuple[str, ...]]:
    """Whether the decoder must be told that the samples are RGB, and what differs from the header.

    A decoder goes by the markers JFIF (YCbCr) and Adobe (either) and by the names of the components. A stream without
    them is taken as YCbCr; where its components are of one size, it may be RGB all the same, as old writers leave it.
    """
    begin = stream[: stream.find(b"\xff\xda")]
    frame_header = re.search(rb"\xff[\xc0-\xc2]..\x08....\x03(.)(.).(.)(.).(.)(.).", begin, re.DOTALL)
    names = b"" if frame_header is None else b"".join(frame_header.group(1, 3, 5))
    sizes = set() if frame_header is None else set(frame_header.group(2, 4, 6))
    adobe = re.search(rb"\xff\xee..Adobe.{6}(.)", begin, re.DOTALL)
    is_rgb = names in (b"RGB", b"rgb") if adobe is None else adobe[1] == b"\0"
    is_declared = adobe is not None or b"JFIF\0" in begin[:32] or is_rgb
    if not is_declared and len(sizes) == 1:
        is_rgb = interpretation in RGB
        ways = [cv2.imdecode(np.frombuffer(one, np.uint8), cv2.IMREAD_COLOR) for one in (stream, _as_rgb(stream))]
        as_ybr, as_rgb = (None if one is None else np.asarray(one, np.uint8) for one in ways)
        if as_ybr is not None and as_rgb is not None:
            is_rgb ^= _is_otherwise(*((as_rgb, as_ybr) if is_rgb else (as_ybr, as_rgb)))
    is_other = not is_declared and is_rgb != (interpretation in RGB)
    notes = (_other_colours(interpretation, "RGB" if is_rgb else "YBR_FULL"),) if is_other else ()
    return is_rgb and not is_declared, notes


def _as_rgb(stream: bytes) -> bytes:
    """A JPEG stream whose decoder is told by Adobe's marker that its samples are RGB."""
    return stream[:2] + b"\xff\xee\x00\x0eAdobe\x00\x64\x00\x00\x00\x00\x00" + stream[2:]
