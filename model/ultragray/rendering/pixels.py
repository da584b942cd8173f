"""Pixels as bytes, and as a PNG file. Free of torch; OpenCV is imported once there are pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray.rendering.settings import Encoding

ByteArray = npt.NDArray[np.uint8]
PixelArray = npt.NDArray[Any]  # float32 as rendered, or uint8: labels, and what is rounded already

JPEG_QUALITY = 90
_IMAGE_FILES: dict[Encoding, tuple[Any, ...]] = {  # suffix, and options in the words of OpenCV
    Encoding.PNG: (".png",),
    Encoding.JPEG: (".jpg", 1, JPEG_QUALITY),  # cv2.IMWRITE_JPEG_QUALITY
}


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


def encoded_image(frame: PixelArray, encoding: Encoding) -> ByteArray:  # [H, W] -> [bytes]
    """A frame as the bytes of a grey image file. Raises KeyError for an encoding that is no image file."""
    return image_file(frame, *_IMAGE_FILES[encoding])


def image_file(frame: PixelArray, suffix: str, *options: int) -> ByteArray:  # [H, W] -> [bytes]
    """A frame as the bytes of a grey image file: `.png` at OpenCV's default settings, `.jpg`."""
    import cv2

    written, data = cv2.imencode(suffix, to_uint8(frame), options)
    assert written  # the sides of a picture are far below what either format holds
    return data.astype(np.uint8, copy=False)
