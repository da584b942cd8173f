"""Real frames as callers give them: files, the bytes of a PNG file, or grey pixels row by row. Free of torch."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ultragray.errors import InvalidArgument
from ultragray.files import map_npy
from ultragray.geometry.image_size import check_image_size
from ultragray.rendering.pixels import ByteArray

SUFFIXES = (".png", ".npy")
_PNG = b"\x89PNG\r\n\x1a\n"
_SIZE_AT = 16  # bytes of a PNG file, where width and height stand


@dataclass(frozen=True, eq=False)
class EncodedFrame:
    """A real frame as a message brings it: a PNG file, or, with its size, grey pixels of 8 bits, row by row.

    Rows lie along depth, columns across scan lines, not scan-converted. Raises InvalidArgument for half a size.
    """

    data: bytes
    height: int | None = None
    width: int | None = None

    def __post_init__(self) -> None:
        if (self.height is None) != (self.width is None):
            raise InvalidArgument(
                "image_height and image_width go together: both for grey pixels, neither for a PNG file",
                field="image_height" if self.height is None else "image_width",
            )

    def pixels(self) -> ByteArray:  # [H, W]
        """Raises InvalidArgument, InvalidImageSize."""
        if self.height is None or self.width is None:
            return read_png(self.data)
        return read_grey(self.data, self.height, self.width)


def read_frame(path: Path) -> Any:  # [H, W]
    """The frame of a `.png` file, or the array of a `.npy` one. Raises InvalidArgument, naming the file."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InvalidArgument(f"a frame must end in {' or '.join(SUFFIXES)}, got {str(path)!r}", field="image")
    try:
        return map_npy(path) if suffix == ".npy" else read_png(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InvalidArgument(f"{path} cannot be read as a frame: {error}", field="image") from None


def read_png(data: bytes, field: str = "image") -> ByteArray:  # [H, W]
    """The frame of a PNG file; colours become their luma, 16 bits become 8.

    Raises InvalidArgument, InvalidImageSize.
    """
    if not data.startswith(_PNG) or len(data) < _SIZE_AT + 8:
        raise InvalidArgument(f"{field} must be a PNG file, which it is not", field=field)
    width, height = struct.unpack_from(">II", data, _SIZE_AT)
    check_image_size(height, width)  # before it takes the memory that the file says
    import cv2

    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise InvalidArgument(f"{field} is a damaged PNG file", field=field)
    return np.asarray(pixels, np.uint8)


def read_grey(data: bytes, height: int, width: int) -> ByteArray:  # [H, W]
    """The frame of uint8 pixels, row by row. Raises InvalidArgument, InvalidImageSize."""
    check_image_size(height, width)
    if len(data) != height * width:
        raise InvalidArgument(
            f"image must hold image_height x image_width = {height * width} bytes of grey pixels, got {len(data)}",
            field="image",
        )
    return np.frombuffer(data, np.uint8).reshape(height, width)
