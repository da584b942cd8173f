"""A PLUS sequence file as it is stored: pixels, and the fields of the file and of each frame.

Both formats that hold sequences (MetaImage, NRRD) write the fields of frame 12 as `Seq_Frame0012_NAME`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from ..errors import DatasetInvalid
from .sweep import ByteArray

MAX_HEADER_BYTES = 256 << 20
MAX_LINE_BYTES = 1 << 20
MAX_BARE_FRAMES = 1_000  # without a field of their own: a few may lack a pose, but a frame costs memory
_FRAME_FIELD = re.compile(r"Seq_Frame(\d{1,9})_(\w+)")


@dataclass(frozen=True)
class StoredSequence:
    """F frames as stored."""

    path: Path
    pixels: ByteArray  # [F, rows, columns] or [F, rows, columns, 3]
    fields: Mapping[str, str]  # of the file
    frame_fields: tuple[Mapping[str, str], ...]  # [F]


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
