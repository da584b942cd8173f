"""DICOM cine loops: a multi-frame ultrasound image (.dcm), and the poses of its frames beside it.

`sweep.dcm` goes with `sweep.poses.npy` or `sweep.poses.json`: one pose for each frame, probe→tracker, mm, whose origin
is the top centre of the region that shows the image (SequenceOfUltrasoundRegions, PS3.3 C.8.5.5), x along its rows of
pixels, z down its columns. Of a convex or phased probe, whose fan on the screen is said in words, the origin is the
apex, z the middle of the fan. Where a file has no regions, the whole image is the region and PixelSpacing its scale.
The extra `dicom`.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ultragray.datasets.fan import FanGeometry, FanLines, parse_fan
from ultragray.datasets.images import (
    MAX_PIXEL_BYTES,
    CropBox,
    grey_frames,
    parse_crop,
    pixel_size_mm,
    poses_from_image_transforms,
    region_of,
)
from ultragray.errors import DatasetInvalid, InvalidArgument, InvalidPose
from ultragray.exchange.poses import load_poses
from ultragray.geometry.probe import FloatArray
from ultragray.installation import missing_extra
from ultragray.learn.sweep import ByteArray, IntArray, Sweep, parse_frame_ranges

POSE_SUFFIXES = (".poses.npy", ".poses.json")
MAX_HEADER_BYTES = 16 << 20  # of all that stands before the pixels
DEFLATED = "1.2.840.10008.1.2.1.99"  # the whole data set is compressed: it could inflate without bounds
CENTIMETRES, TISSUE_2D = 3, 1
INTERPRETATIONS = {"MONOCHROME2": 1, "RGB": 3, "YBR_FULL": 3, "YBR_FULL_422": 3}  # samples of a pixel
SMALLEST_PIXEL_MM, LARGEST_PIXEL_MM = 1e-4, 10.0


def read_dicom_sweep(
    path: Path, *, frames: str | None = None, crop: str | None = None, fan: str | None = None
) -> tuple[Sweep, int]:
    """The frames of a cine loop, and their number in the file.

    `frames` (ranges, `parse_frame_ranges`) chooses among them; `crop` is "columns,rows" of the stored image, default:
    the region. `fan` (`parse_fan`) says that the image is that of a convex or phased probe: the frames are its scan
    lines. Colour becomes luma. Raises DatasetInvalid, naming the file, the frame and the reason; InvalidArgument for
    options that do not fit; ExtraMissing without pydicom.
    """
    if fan is not None and crop is not None:
        raise InvalidArgument("fan must be given without crop: it says where the image lies", field="fan")
    header = _read_header(path)
    shape = _shape(path, header, is_fan=fan is not None)
    region, pixel_mm = _region(path, header, shape)
    poses = _read_poses(path, shape[0])
    ranges = range(shape[0]) if frames is None else parse_frame_ranges(frames, shape[0], option="frames")
    chosen = np.array(ranges, np.int64)
    stored = _read_frames(path, header, shape, chosen)
    notes = () if "TransducerType" in header else ("the file does not name its transducer: taken as a linear one",)
    if fan is not None:
        return _fan_sweep(path, stored, poses[chosen], parse_fan(fan), pixel_mm, chosen), shape[0]
    box = region if crop is None else parse_crop(crop, *shape[1:])
    lateral_mm, axial_mm = pixel_mm
    image_to_probe = np.array(
        [
            [lateral_mm, 0.0, 0.0, -lateral_mm * (region.left + region.right - 1) / 2],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, axial_mm, 0.0, -axial_mm * (region.top - 0.5)],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    box_poses, probe = poses_from_image_transforms(poses[chosen] @ image_to_probe, box, chosen, path)
    images = stored[:, box.top : box.bottom, box.left : box.right]
    shown = region_of(shape[1:], box, pixel_size_mm(poses[:1] @ image_to_probe), image_to_probe)
    sweep = Sweep(np.ascontiguousarray(images), box_poses, probe, chosen, str(path), notes, shown)
    return sweep, shape[0]


def _fan_sweep(
    path: Path,
    stored: ByteArray,  # [F, rows, columns]
    poses: FloatArray,  # [F, 4, 4]
    geometry: FanGeometry,
    pixel_mm: tuple[float, float],
    numbers: IntArray,
) -> Sweep:
    """The scan lines of a fan on the screen. Raises InvalidArgument for one that does not lie in the image."""
    size, (lateral_mm, axial_mm) = (stored.shape[1], stored.shape[2]), pixel_mm
    lines = FanLines(geometry, size, pixel_mm)
    image_to_probe = np.array(
        [
            [lateral_mm, 0.0, 0.0, -lateral_mm * geometry.apex_column],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, axial_mm, 0.0, -axial_mm * geometry.apex_row],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    region = region_of(size, lines.box, pixel_mm, image_to_probe)
    return Sweep(lines.frames(stored), poses, geometry.probe(), numbers, str(path), (), region)


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

        if read_file_meta_info(path).get("TransferSyntaxUID", "") == DEFLATED:
            raise DatasetInvalid(f"{path}: its data set is deflated, which is not read: save it in another syntax")
        with _BoundedFile(path) as file:
            return pydicom.dcmread(file, stop_before_pixels=True)


def _value(path: Path, header: Any, name: str) -> Any:
    with _in_our_words(path):  # pydicom reads a value when it is first asked for
        value = header.get(name)
    if value is None or value == "":
        raise DatasetInvalid(f"{path}: it lacks {name}")
    return value


def _shape(path: Path, header: Any, *, is_fan: bool) -> tuple[int, int, int]:  # frames, rows, columns
    """The size of the frames. Raises DatasetInvalid for what is no cine loop of 8 bits in grey or colour, and for a
    probe that is not linear unless its fan is known."""
    if (bits := _value(path, header, "BitsAllocated")) != 8:
        raise DatasetInvalid(f"{path}: pixels must have 8 bits (BitsAllocated 8), got {str(bits)[:40]}")
    interpretation = str(_value(path, header, "PhotometricInterpretation"))
    samples = _value(path, header, "SamplesPerPixel")
    if INTERPRETATIONS.get(interpretation) != samples:
        raise DatasetInvalid(
            f"{path}: PhotometricInterpretation must be {', '.join(INTERPRETATIONS)} with SamplesPerPixel 1 or 3, got "
            f"{interpretation[:40]} with {str(samples)[:40]}"
        )
    with _in_our_words(path):
        transducer = str(header.get("TransducerType", "LINEAR"))
    if transducer not in ("LINEAR", "") and not is_fan:
        raise DatasetInvalid(
            f"{path}: the probe is not linear, TransducerType is {transducer[:40]}: say with fan where it lies on the "
            "screen"
        )
    names = ("NumberOfFrames", "Rows", "Columns")
    with _in_our_words(path):
        frames, rows, columns = (int(_value(path, header, name)) for name in names)
    if min(frames, rows, columns) < 1 or frames * rows * columns * int(samples) > MAX_PIXEL_BYTES:
        raise DatasetInvalid(
            f"{path}: it must have 1 to {MAX_PIXEL_BYTES:,} pixels, its header says {frames} x {rows} x {columns}"
        )
    return frames, rows, columns


def _region(path: Path, header: Any, shape: tuple[int, int, int]) -> tuple[CropBox, tuple[float, float]]:
    """The part of the image that shows ultrasound, and the lateral and axial size of its pixels, mm."""
    _, rows, columns = shape
    with _in_our_words(path):
        regions = [one for one in header.get("SequenceOfUltrasoundRegions", []) if _is_tissue(one)]
        if len(regions) > 1:
            raise DatasetInvalid(f"{path}: it has {len(regions)} regions that show a plane, one is expected")
        if regions:
            (region,) = regions
            left, top, right, bottom = (
                int(_value(path, region, f"RegionLocation{name}")) for name in ("MinX0", "MinY0", "MaxX1", "MaxY1")
            )
            box = CropBox(left, right + 1, top, bottom + 1)
            lateral_mm, axial_mm = (10.0 * float(_value(path, region, f"PhysicalDelta{axis}")) for axis in "XY")
        else:
            box = CropBox(0, columns, 0, rows)
            if "PixelSpacing" not in header:
                raise DatasetInvalid(
                    f"{path}: it does not say how large a pixel is: no region of SequenceOfUltrasoundRegions in "
                    "centimetres, and no PixelSpacing"
                )
            axial_mm, lateral_mm = (float(spacing) for spacing in header.PixelSpacing)
    if not (0 <= box.left < box.right <= columns and 0 <= box.top < box.bottom <= rows):
        raise DatasetInvalid(f"{path}: its region {box} does not lie within {columns} x {rows} pixels")
    if not all(SMALLEST_PIXEL_MM <= size <= LARGEST_PIXEL_MM for size in (lateral_mm, axial_mm)):
        raise DatasetInvalid(
            f"{path}: a pixel must be {SMALLEST_PIXEL_MM:g} to {LARGEST_PIXEL_MM:g} mm, it is {lateral_mm:g} x "
            f"{axial_mm:g} mm"
        )
    return box, (lateral_mm, axial_mm)


def _is_tissue(region: Any) -> bool:
    units = (region.get("PhysicalUnitsXDirection"), region.get("PhysicalUnitsYDirection"))
    return region.get("RegionSpatialFormat") == TISSUE_2D and units == (CENTIMETRES, CENTIMETRES)


def _read_poses(path: Path, count: int) -> FloatArray:  # [F, 4, 4]
    named = [path.with_name(f"{path.name[: -len(path.suffix)]}{suffix}") for suffix in POSE_SUFFIXES]
    found = [file for file in named if file.is_file()]
    if len(found) != 1:
        wanted = " or ".join(file.name for file in named)
        raise DatasetInvalid(f"{path}: the poses of its frames must lie beside it in {wanted}, found {len(found)}")
    try:
        poses = load_poses(found[0])
    except InvalidPose as error:
        raise DatasetInvalid(error.detail) from error
    if len(poses) != count:
        raise DatasetInvalid(f"{path} holds {count} frames, but {found[0]} {len(poses)} poses")
    return poses


def _read_frames(path: Path, header: Any, shape: tuple[int, int, int], chosen: IntArray) -> ByteArray:
    """The chosen frames [C, rows, columns], decoded one at a time; colours become their luma."""
    frames = np.empty((len(chosen), *shape[1:]), np.uint8)
    with _in_our_words(path):
        from pydicom.pixels import get_decoder, iter_pixels

        syntax = header.file_meta.TransferSyntaxUID
        try:
            decoder = get_decoder(syntax) if syntax.is_compressed else None
        except NotImplementedError:
            raise DatasetInvalid(f"{path}: pixels compressed as {syntax.name} cannot be read") from None
        if decoder is not None and not decoder.is_available:
            needed = "; ".join(decoder.missing_dependencies)
            raise DatasetInvalid(
                f"{path}: pixels compressed as {syntax.name} cannot be read without a decoder: {needed}"
            )
        is_colour = INTERPRETATIONS[str(header.PhotometricInterpretation)] == 3
        # Not raw: YBR becomes RGB.
        pixels = iter_pixels(path, indices=[int(number) for number in chosen], raw=not is_colour)
        for number, out in zip(chosen, frames, strict=True):
            with _in_our_words(f"{path}: frame {number}"):
                frame = next(pixels)
            expected = (*out.shape, 3) if is_colour else out.shape
            if frame.shape != expected or frame.dtype != out.dtype:
                raise DatasetInvalid(
                    f"{path}: frame {number} must be uint8 {list(expected)}, got {frame.dtype} {list(frame.shape)}"
                )
            out[:] = grey_frames(frame[None], str(path))[0]
    return frames
