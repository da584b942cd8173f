"""Sequences of PLUS as files, MetaImage and NRRD: header, orientation and pixels, nothing of which is trusted.

Both formats write the fields of frame 12 as `Seq_Frame0012_NAME`. The readers are ours: pynrrd and SimpleITK inflate
whatever a header promises, and SimpleITK alone weighs 50 MB.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ultragray.datasets.images import MAX_PIXEL_BYTES
from ultragray.errors import DatasetInvalid
from ultragray.learn.sweep import ByteArray

MAX_HEADER_BYTES = 256 << 20
MAX_LINE_BYTES = 1 << 20
MAX_BARE_FRAMES = 1_000  # without a field of their own: a few may lack a pose, but a frame costs memory
_ZLIB_OR_GZIP = 47  # zlib's window bits for either kind of header
_FRAME_FIELD = re.compile(r"Seq_Frame(\d{1,9})_(\w+)")


@dataclass(frozen=True)
class StoredSequence:
    """F frames as stored."""

    path: Path
    pixels: ByteArray  # [F, rows, columns] or [F, rows, columns, 3]
    fields: Mapping[str, str]  # of the file
    frame_fields: tuple[Mapping[str, str], ...]  # [F]
    notes: tuple[str, ...] = ()  # what reading the pixels changed


def header_lines(file: BinaryIO, path: Path) -> Iterator[str]:
    """The lines of a text header, as far as the caller goes. Raises DatasetInvalid where they are no text."""
    total = 0
    while line := file.readline(MAX_LINE_BYTES + 1):
        total += len(line)
        if len(line) > MAX_LINE_BYTES or total > MAX_HEADER_BYTES or b"\0" in line:
            raise DatasetInvalid(f"{path}: not a sequence file: its header is no text")
        yield line.decode("utf-8", errors="replace").rstrip("\r\n")


def split_fields(
    path: Path, entries: Mapping[str, str], frame_count: int
) -> tuple[dict[str, str], tuple[Mapping[str, str], ...]]:
    """The fields of the file, and those of each of its frames; fields of frames beyond them are left out.

    Raises DatasetInvalid for a number of frames far beyond those that have fields.
    """
    fields: dict[str, str] = {}
    frames: dict[int, dict[str, str]] = {}
    for key, value in entries.items():
        match = _FRAME_FIELD.fullmatch(key)
        if match is None:
            fields[key] = value
        elif int(match[1]) < frame_count:
            frames.setdefault(int(match[1]), {})[match[2]] = value
    if frame_count > len(frames) + MAX_BARE_FRAMES:
        raise DatasetInvalid(f"{path}: its header says {frame_count} frames, but has fields of {len(frames)} only")
    return fields, tuple(frames.get(number, {}) for number in range(frame_count))


def pixel_shape(path: Path, sizes: list[int], channels: int) -> tuple[int, ...]:  # [F, rows, columns(, channels)]
    """The shape of the pixels from the sizes of a header, fastest axis first: columns, rows, frames.

    A fourth size goes with volumes of one slice. Raises DatasetInvalid for other volumes.
    """
    if len(sizes) == 4 and sizes[2] == 1:
        sizes = [*sizes[:2], sizes[3]]
    if len(sizes) != 3:
        raise DatasetInvalid(f"{path}: a sequence has columns x rows x frames, got {' x '.join(map(str, sizes))}")
    if channels not in (1, 3, 4):
        raise DatasetInvalid(f"{path}: pixels must have 1, 3 or 4 channels, got {channels}")
    shape = tuple(reversed(sizes))
    return shape if channels == 1 else (*shape, channels)


def whole_numbers(path: Path, key: str, text: str) -> list[int]:
    """The whole numbers of a header's field. Raises DatasetInvalid."""
    words = text.split()
    if not words or not all(re.fullmatch(r"\d{1,12}", word) for word in words):
        raise DatasetInvalid(f"{path}: {key} must be whole numbers, got {text[:80]!r}")
    return [int(word) for word in words]


def read_payload(
    header: Path, file_name: str | None, offset: int, shape: tuple[int, ...], *, deflated: bool
) -> ByteArray:
    """uint8 pixels of `shape`, from `offset` of the header's file, or of `file_name` beside it.

    Raises DatasetInvalid, naming the file, where there are fewer or more bytes than the shape holds, or the deflated
    bytes are damaged; what is inflated never exceeds the shape.
    """
    path = header if file_name is None else _beside(header, file_name)
    expected = int(np.prod([int(side) for side in shape], dtype=object))
    if not 0 < expected <= MAX_PIXEL_BYTES:
        raise DatasetInvalid(
            f"{header}: {' x '.join(map(str, shape))} bytes of pixels, the limit is {MAX_PIXEL_BYTES >> 30} GiB"
        )
    if not deflated:
        _require_size(path, header, max(0, path.stat().st_size - offset), expected)
        return np.fromfile(path, np.uint8, expected, offset=offset).reshape(shape)
    with path.open("rb") as file:
        file.seek(offset)
        deflated_limit = expected + expected // 256 + (1 << 16)  # incompressible pixels grow by far less
        pixels = _inflate(file.read(deflated_limit), path, expected)
    _require_size(path, header, len(pixels), expected)
    return np.frombuffer(pixels, np.uint8).reshape(shape)


def read_wide_payload(
    header: Path, file_name: str | None, offset: int, shape: tuple[int, ...], dtype: str, *, deflated: bool
) -> tuple[ByteArray, str]:
    """Pixels of 16 bits (a numpy dtype such as ">i2") as uint8 of `shape`, and a note that says how.

    The power of two above the largest value of the file becomes 256, so that sequences of one scanner are scaled
    alike. Raises what `read_payload` raises, and DatasetInvalid for values below 0.
    """
    stored = read_payload(header, file_name, offset, (*shape, 2), deflated=deflated).view(dtype)[..., 0]
    if int(stored.min()) < 0:
        raise DatasetInvalid(f"{header}: 16-bit pixels must not be below 0, the smallest is {stored.min()}")
    surplus = max(0, int(stored.max()).bit_length() - 8)
    pixels = np.empty(shape, np.uint8)
    for frame, out in zip(stored, pixels, strict=True):
        out[:] = frame >> surplus
    return pixels, f"pixels of 16 bits were made 8: {(256 << surplus) - 1} became 255"


def _inflate(data: bytes, path: Path, expected: int) -> bytes:
    inflater = zlib.decompressobj(_ZLIB_OR_GZIP)
    try:
        pixels = inflater.decompress(data, expected + 1)
    except zlib.error as error:
        raise DatasetInvalid(f"{path}: its compressed pixels are damaged: {error}") from error
    if not inflater.eof and len(pixels) <= expected:
        raise DatasetInvalid(f"{path}: truncated: its compressed pixels end after {len(pixels)} of {expected} bytes")
    return pixels


def _require_size(path: Path, header: Path, found: int, expected: int) -> None:
    if found < expected:
        raise DatasetInvalid(
            f"{path}: truncated: {found} bytes of pixels, but the header of {header.name} needs {expected}"
        )
    if found > expected:
        raise DatasetInvalid(f"{path}: more pixels than the {expected} bytes that the header of {header.name} says")


def _beside(header: Path, file_name: str) -> Path:
    if Path(file_name).name != file_name:
        raise DatasetInvalid(f"{header}: its pixels must lie beside it, it names {file_name[:200]!r}")
    path = header.parent / file_name
    if not path.is_file():
        raise DatasetInvalid(f"{header}: the file {file_name[:200]!r} with its pixels was not found beside it")
    return path


# MetaImage sequences: .mha (also .igs.mha), and .mhd with its pixels in a .raw or .zraw file.


_DTYPES = {"MET_UCHAR": "u1", "MET_USHORT": "u2", "MET_SHORT": "i2"}
_MOST_SIGNIFICANT_FIRST = ("BinaryDataByteOrderMSB", "ElementByteOrderMSB")


def read_meta_image(path: Path) -> StoredSequence:
    """The sequence in a MetaImage file of 8 or 16 bits a pixel. Raises DatasetInvalid, naming file and reason."""
    with path.open("rb") as file:
        entries: dict[str, str] = {}
        for line in header_lines(file, path):
            key, separator, value = (part.strip() for part in line.partition("="))
            if not separator and line.strip():
                raise DatasetInvalid(f"{path}: not a MetaImage file: a line of its header is {line[:80]!r}")
            entries[key] = value
            if key == "ElementDataFile":  # by definition the last line
                break
        else:
            raise DatasetInvalid(f"{path}: not a MetaImage file, or truncated: its header has no ElementDataFile")
        offset = file.tell()
    dtype = _DTYPES.get(entries.get("ElementType", ""))
    if dtype is None or entries.get("BinaryData", "True").lower() != "true":
        raise DatasetInvalid(
            f"{path}: pixels must be binary {', '.join(_DTYPES)}, got ElementType "
            f"{entries.get('ElementType', 'missing')}"
        )
    sizes = whole_numbers(path, "DimSize", entries.get("DimSize", ""))
    channels = whole_numbers(path, "ElementNumberOfChannels", entries.get("ElementNumberOfChannels", "1"))[0]
    shape = pixel_shape(path, sizes, channels)
    fields, frame_fields = split_fields(path, entries, shape[0])
    local = entries["ElementDataFile"].upper() == "LOCAL"
    header_size = whole_numbers(path, "HeaderSize", entries.get("HeaderSize", "0"))[0]
    place = (None if local else entries["ElementDataFile"], offset if local else header_size, shape)
    deflated = entries.get("CompressedData", "False").lower() == "true"
    if dtype == "u1":
        return StoredSequence(path, read_payload(path, *place, deflated=deflated), fields, frame_fields)
    most_first = any(entries.get(key, "False").lower() == "true" for key in _MOST_SIGNIFICANT_FIRST)
    pixels, note = read_wide_payload(path, *place, (">" if most_first else "<") + dtype, deflated=deflated)
    return StoredSequence(path, pixels, fields, frame_fields, (note,))


# NRRD sequences: .nrrd and .seq.nrrd, and .nhdr with its pixels in a file of their own; raw or gzip.


_NRRD_DTYPES = {
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"),
}
_TIME_KINDS = ("list", "time")
_COLOUR_KINDS = ("vector", "rgb-color", "rgba-color", "3-color", "4-color", "3-vector", "4-vector")


def read_nrrd(path: Path) -> StoredSequence:
    """The sequence in an NRRD file of 8 or 16 bits a pixel. Raises DatasetInvalid, naming file and reason."""
    with path.open("rb") as file:
        fields, own = _read_header(file, path)
        offset = file.tell()
    dtype = _NRRD_DTYPES.get(fields.get("type", "").lower())
    if dtype is None:
        raise DatasetInvalid(f"{path}: pixels must be uchar, ushort or short, got type {fields.get('type', 'missing')}")
    encoding = fields.get("encoding", "").lower()
    if encoding not in ("raw", "gzip", "gz"):
        raise DatasetInvalid(f"{path}: encoding must be raw or gzip, got {encoding or 'none'}")
    if any(fields.get(key, "0") != "0" for key in ("line skip", "lineskip", "byte skip", "byteskip")):
        raise DatasetInvalid(f"{path}: files with a line skip or byte skip cannot be read")
    shape = _shape(path, fields)
    file_fields, frame_fields = split_fields(path, own, shape[0])
    data_file = fields.get("data file", fields.get("datafile"))
    place, deflated = (data_file, 0 if data_file else offset, shape), encoding != "raw"
    if dtype == "u1":
        return StoredSequence(path, read_payload(path, *place, deflated=deflated), file_fields, frame_fields)
    order = ">" if fields.get("endian", "little").lower() == "big" else "<"
    pixels, note = read_wide_payload(path, *place, order + dtype, deflated=deflated)
    return StoredSequence(path, pixels, file_fields, frame_fields, (note,))


def _read_header(file: BinaryIO, path: Path) -> tuple[dict[str, str], dict[str, str]]:
    """The format's fields (`sizes: …`, by lower-case name) and the file's own (`Seq_Frame0000_…:=…`)."""
    lines = header_lines(file, path)
    if not next(lines, "").startswith("NRRD000"):
        raise DatasetInvalid(f"{path}: not an NRRD file: it does not begin with NRRD000")
    fields: dict[str, str] = {}
    own: dict[str, str] = {}
    for line in lines:
        if not line:
            break
        key, separator, value = line.partition(":")
        if line.startswith("#"):
            continue
        if not separator:
            raise DatasetInvalid(f"{path}: not an NRRD file: a line of its header is {line[:80]!r}")
        if value.startswith("="):
            own[key.strip()] = value[1:].strip()
        else:
            fields[key.strip().lower()] = value.strip()
    return fields, own


def _shape(path: Path, fields: dict[str, str]) -> tuple[int, ...]:  # [F, rows, columns(, channels)]
    sizes = whole_numbers(path, "sizes", fields.get("sizes", ""))
    kinds = fields.get("kinds", "").lower().split()
    channels = 1
    if len(kinds) == len(sizes):
        if kinds[0] in _COLOUR_KINDS:
            channels, sizes, kinds = sizes[0], sizes[1:], kinds[1:]
        if any(kind in _TIME_KINDS for kind in kinds[:-1]):
            raise DatasetInvalid(f"{path}: the frames must be the last axis, got kinds {fields['kinds']!r}")
    return pixel_shape(path, sizes, channels)


# UltrasoundImageOrientation of PLUS: where a stored image's axes point.
#
# Two letters say where the columns and then the rows of the stored image go: M or U, towards the marked or the
# unmarked side of the probe; F or N, away from the transducer (far) or towards it (near). FM: depth goes along a row.
# A third letter, A or D, is about stacks of slices and does not matter here. XX or nothing: unknown, taken as MF.


UNKNOWN = ("", "XX")


def orient_frames(frames: ByteArray, orientation: str, path: Path) -> ByteArray:
    """Stored frames [F, rows, columns] as MF: columns towards the marked side (x), rows away from the probe (z).

    PLUS calibrates, and so defines the frame `Image` of its transforms, on images brought to MF. Raises DatasetInvalid
    for an orientation that no 2D image has.
    """
    if orientation in UNKNOWN:
        return frames
    if not re.fullmatch(r"([MU][FN]|[FN][MU])[AD]?", orientation):
        raise DatasetInvalid(
            f"{path}: UltrasoundImageOrientation must be MF, MN, UF, UN, FM, NM, FU or NU, and A or D, or XX, got "
            f"{orientation[:20]!r}"
        )
    lateral, depth = orientation[0], orientation[1]
    if lateral in "FN":  # the image is transposed
        frames = np.swapaxes(frames, 1, 2)
        lateral, depth = depth, lateral
    if lateral == "U":
        frames = frames[:, :, ::-1]
    if depth == "N":
        frames = frames[:, ::-1]
    return frames
