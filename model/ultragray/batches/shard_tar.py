"""The file of a shard: a WebDataset tar, of each frame a .npy of each output and a .json with pose and figures.

Written here rather than by `tarfile`, whose members and PNGs took a quarter of the time that the kernel takes for a
frame of 64x64 pixels. Times and owners are 0, so that the same frames are the same bytes.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ultragray.confidence import Extrapolation
from ultragray.display.pixels import PixelArray
from ultragray.errors import InvalidArgument
from ultragray.probe import FloatArray

_BLOCK, _RECORD = 512, 10_240  # bytes
_MAX_MEMBER = 8**11 - 1  # bytes: what the field of a header holds
_FIGURE_DIGITS = 6


class ShardTar:
    """A tar that is written portion by portion, and hashed on the way."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._digest = hashlib.sha256()
        self.bytes = 0

    def __enter__(self) -> ShardTar:
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()

    def add(
        self,
        keys: Sequence[str],  # [B]
        poses: FloatArray,  # [B, 4, 4] mm
        figures: Sequence[Extrapolation],  # [B]
        frames: Mapping[str, PixelArray],  # [B, H, W] by output
    ) -> None:
        """Append frames. Raises OSError, InvalidArgument for frames larger than a member can be."""
        heads = {name: npy_head(pixels[0]) for name, pixels in frames.items()}
        parts: list[bytes | memoryview] = []
        for place, (key, pose, figure) in enumerate(zip(keys, poses.tolist(), figures, strict=True)):
            for name, pixels in frames.items():
                data = pixels[place].data.cast("B")
                parts += _member(f"{key}.{name}.npy", heads[name], data)
            document = {"pose": pose, **{name: _rounded(value) for name, value in figure.figures().items()}}
            parts += _member(f"{key}.json", json.dumps(document).encode())
        self._write(b"".join(parts))

    def finish(self) -> str:
        """Write the end of the tar; its SHA-256, hexadecimal. Raises OSError."""
        end = self.bytes + 2 * _BLOCK
        self._write(bytes(2 * _BLOCK + -end % _RECORD))
        self._file.flush()
        return self._digest.hexdigest()

    def _write(self, data: bytes) -> None:
        self._file.write(data)
        self._digest.update(data)
        self.bytes += len(data)


def npy_head(frame: PixelArray) -> bytes:
    """What comes before the pixels of a frame in a .npy file."""
    file = io.BytesIO()
    described = {"descr": frame.dtype.str, "fortran_order": False, "shape": frame.shape}
    np.lib.format.write_array_header_1_0(file, described)
    return file.getvalue()


def _member(name: str, *parts: bytes | memoryview) -> list[bytes | memoryview]:
    size = sum(map(len, parts))
    return [_header(name, size), *parts, bytes(-size % _BLOCK)]


def _fields(name: bytes, size: bytes, checksum: bytes) -> bytes:
    """A header of POSIX.1-1988 (ustar): a file of mode 644, of nobody, from 1970."""
    return b"".join(
        (
            name.ljust(100, b"\0"),
            b"0000644\0",
            b"0000000\0" * 2,
            size,
            b"00000000000\0",
            checksum,
            b"0",
            bytes(100),
            b"ustar\00000",
            bytes(247),
        )
    )


_EMPTY_SUM = sum(_fields(b"", bytes(12), b" " * 8))


def _header(name: str, size: int) -> bytes:
    written, octal = name.encode("ascii"), b"%011o\0" % size
    if len(written) > 100 or size > _MAX_MEMBER:
        raise InvalidArgument(f"a shard holds no member of {size:,} bytes called {name}", field="outputs")
    return _fields(written, octal, b"%06o\0 " % (_EMPTY_SUM + sum(written) + sum(octal)))


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, _FIGURE_DIGITS)
