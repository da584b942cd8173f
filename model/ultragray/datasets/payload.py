"""The pixels of a sequence file: raw or deflated, in the header's own file or beside it, never more than it says."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np

from ..errors import DatasetInvalid
from .sweep import ByteArray

MAX_PIXEL_BYTES = 4 << 30
_ZLIB_OR_GZIP = 47  # zlib's window bits for either kind of header


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
        found = max(0, path.stat().st_size - offset)
        if found != expected:
            raise DatasetInvalid(_wrong_size(path, header, found, expected))
        return np.fromfile(path, np.uint8, expected, offset=offset).reshape(shape)
    with path.open("rb") as file:
        file.seek(offset)
        deflated_limit = expected + expected // 256 + (1 << 16)  # incompressible pixels grow by far less
        pixels = _inflate(file.read(deflated_limit), path, expected)
    if len(pixels) != expected:
        raise DatasetInvalid(_wrong_size(path, header, len(pixels), expected))
    return np.frombuffer(pixels, np.uint8).reshape(shape)


def _inflate(data: bytes, path: Path, expected: int) -> bytes:
    inflater = zlib.decompressobj(_ZLIB_OR_GZIP)
    try:
        pixels = inflater.decompress(data, expected + 1)
    except zlib.error as error:
        raise DatasetInvalid(f"{path}: its compressed pixels are damaged: {error}") from error
    if not inflater.eof and len(pixels) <= expected:
        raise DatasetInvalid(f"{path}: truncated: its compressed pixels end after {len(pixels)} of {expected} bytes")
    return pixels


def _wrong_size(path: Path, header: Path, found: int, expected: int) -> str:
    if found < expected:
        return f"{path}: truncated: {found} bytes of pixels, but the header of {header.name} needs {expected}"
    return f"{path}: more pixels than the {expected} bytes that the header of {header.name} says"


def _beside(header: Path, file_name: str) -> Path:
    if Path(file_name).name != file_name:
        raise DatasetInvalid(f"{header}: its pixels must lie beside it, it names {file_name[:200]!r}")
    path = header.parent / file_name
    if not path.is_file():
        raise DatasetInvalid(f"{header}: the file {file_name[:200]!r} with its pixels was not found beside it")
    return path
