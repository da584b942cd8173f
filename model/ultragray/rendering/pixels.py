"""Pixels as bytes, and as image files. Free of torch; OpenCV and ISA-L are imported once there are pixels."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray.rendering.settings import Encoding

ByteArray = npt.NDArray[np.uint8]
PixelArray = npt.NDArray[Any]  # float32 as rendered, or uint8: labels, and what is rounded already

JPEG_QUALITY = 90
_PNG_SIGNATURE, _UP = b"\x89PNG\r\n\x1a\n", 2  # ISO/IEC 15948, §5.2 and §9.2


def to_uint8(frames: PixelArray) -> ByteArray:
    """round(255·min(x, 1)), half to even, the same shape; labels as they are. No output of a renderer is negative."""
    if frames.dtype == np.uint8:
        return frames
    import cv2

    rows = frames.reshape(-1, frames.shape[-1])
    return cv2.convertScaleAbs(rows, alpha=255.0).astype(np.uint8, copy=False).reshape(frames.shape)


def in_type(frames: PixelArray, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Frames in a type of pixels, C order, little endian: uint8 as `to_uint8` rounds, labels as they are."""
    wanted = np.dtype(dtype)
    return np.ascontiguousarray(to_uint8(frames) if wanted == np.uint8 else frames, wanted.newbyteorder("<"))


def encoded_image(frame: PixelArray, encoding: Encoding) -> bytes:  # [H, W]
    """A frame as a grey image file. Raises ValueError for an encoding that is no image file."""
    match encoding:
        case Encoding.PNG:
            return png_file(frame)
        case Encoding.JPEG:
            import cv2

            written, data = cv2.imencode(".jpg", to_uint8(frame), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            assert written  # the sides of a picture are far below what the format holds
            return data.tobytes()
        case _:
            raise ValueError(f"{encoding.value} is no image file")


def png_file(frame: PixelArray) -> bytes:  # [H, W]
    """A frame as a grey PNG file, each row as its difference from the one above.

    ISA-L deflates a picture in a sixth of the time that OpenCV takes, to three quarters of its size.
    """
    from isal import isal_zlib

    picture = to_uint8(frame)
    height, width = picture.shape
    rows = np.empty((height, 1 + width), np.uint8)
    rows[:, 0] = _UP
    rows[:1, 1:] = picture[:1]
    np.subtract(picture[1:], picture[:-1], out=rows[1:, 1:])
    size = struct.pack(">2I5B", width, height, 8, 0, 0, 0, 0)  # 8 bits of grey
    chunks = ((b"IHDR", size), (b"IDAT", isal_zlib.compress(rows, 1)), (b"IEND", b""))
    return _PNG_SIGNATURE + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", isal_zlib.crc32(data, isal_zlib.crc32(kind)))
        for kind, data in chunks
    )
