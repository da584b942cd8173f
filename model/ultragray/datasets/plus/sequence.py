"""A PLUS sequence file as it is stored: the fields of the file and of each frame, and the pixels.

Both formats that hold sequences (MetaImage, NRRD) write the fields of frame 12 as `Seq_Frame0012_NAME`.
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
from ultragray.datasets.sweep import ByteArray
from ultragray.errors import DatasetInvalid

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
