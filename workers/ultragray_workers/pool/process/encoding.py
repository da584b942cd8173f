"""Frames as bytes: the pixel work, done in the worker processes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, BinaryIO

import cv2
import numpy as np
import numpy.typing as npt

from ultragray.confidence import Extrapolation, figure_arrays
from ultragray.errors import RenderFailed
from ultragray.probe import FloatArray
from ultragray.request import LABELS

from ..types import Encoding

JPEG_QUALITY = 90

FrameArray = npt.NDArray[np.float32]
ByteArray = npt.NDArray[np.uint8]
PixelArray = npt.NDArray[Any]  # float32 as rendered, or uint8: labels, and what a GPU has rounded


def to_uint8(frames: PixelArray) -> ByteArray:
    """round(255·min(x, 1)), half to even, the same shape; labels as they are. No output of a renderer is negative."""
    if frames.dtype == np.uint8:
        return frames
    rows = frames.reshape(-1, frames.shape[-1])
    return cv2.convertScaleAbs(rows, alpha=255.0).astype(np.uint8, copy=False).reshape(frames.shape)


def encode_pixels(frames: PixelArray, encoding: Encoding) -> npt.NDArray[np.generic]:  # [C, H, W] -> [C, H, W]
    """Frames in the pixel type of an encoding, C order, little endian; labels keep their values."""
    pixel_type = encoding.pixel_type
    pixels: npt.NDArray[Any] = to_uint8(frames) if pixel_type == np.uint8 else frames
    return np.ascontiguousarray(pixels, dtype=pixel_type)


def encode_image(frame: PixelArray, encoding: Encoding) -> ByteArray:  # [H, W] -> [bytes]
    """A frame as the bytes of a grey PNG (at OpenCV's default settings) or JPEG file."""
    suffix, options = (".png", []) if encoding is Encoding.PNG else (".jpg", [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    written, data = cv2.imencode(suffix, to_uint8(frame), options)
    if not written:
        raise RenderFailed(f"a frame of {frame.shape[0]}x{frame.shape[1]} pixels could not be written as {suffix[1:]}")
    return data.astype(np.uint8, copy=False)


def npz_type(output: str) -> np.dtype[Any]:
    """The type of an output's array in an .npz archive."""
    return np.dtype("u1") if output == LABELS else np.dtype("<f4")


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
        **{name: np.asarray(pixels, npz_type(name)) for name, pixels in frames.items()},
        "poses": np.asarray(poses, dtype=np.float64),
        **figure_arrays(extrapolations),
        "scene": np.array(scene),
        "scene_sha256": np.array(scene_sha256),
        "renderer": np.array(renderer),
    }
    np.savez(file, **arrays)
    return file.tell()
