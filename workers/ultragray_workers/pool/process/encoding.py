"""Frames as bytes: the pixel work, done in the worker processes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, BinaryIO

import cv2
import numpy as np
import numpy.typing as npt

from ultragray.confidence import Extrapolation, figure_arrays
from ultragray.display.pixels import ByteArray, PixelArray, image_file, to_uint8
from ultragray.outputs import OUTPUTS
from ultragray.probe import FloatArray
from ultragray.settings import Encoding

JPEG_QUALITY = 90


def encode_pixels(frames: PixelArray, encoding: Encoding) -> npt.NDArray[np.generic]:  # [C, H, W] -> [C, H, W]
    """Frames in the pixel type of an encoding, C order, little endian; labels keep their values."""
    pixel_type = encoding.pixel_type
    pixels: npt.NDArray[Any] = to_uint8(frames) if pixel_type == np.uint8 else frames
    return np.ascontiguousarray(pixels, dtype=pixel_type)


def encode_image(frame: PixelArray, encoding: Encoding) -> ByteArray:  # [H, W] -> [bytes]
    """A frame as the bytes of a grey PNG (at OpenCV's default settings) or JPEG file."""
    if encoding is Encoding.PNG:
        return image_file(frame, ".png")
    return image_file(frame, ".jpg", cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY)


def write_npz(
    file: BinaryIO,
    frames: Mapping[str, PixelArray],  # each [C, H, W]
    poses: FloatArray,  # [C, 4, 4] mm
    extrapolations: Sequence[Extrapolation],  # [C]
    *,
    scene: str,
    scene_sha256: str,
    renderer: str,
) -> int:
    """Writes an .npz archive, labels as uint8, at the start of `file` and returns its size in bytes."""
    file.seek(0)
    arrays: dict[str, Any] = {
        **{name: np.asarray(pixels, OUTPUTS[name].dtype) for name, pixels in frames.items()},
        "poses": np.asarray(poses, dtype=np.float64),
        **figure_arrays(extrapolations),
        "scene": np.array(scene),
        "scene_sha256": np.array(scene_sha256),
        "renderer": np.array(renderer),
    }
    np.savez(file, **arrays)
    return file.tell()
