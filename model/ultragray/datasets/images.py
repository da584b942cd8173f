"""Frames as they are stored, made uint8 [F, H, W]; cropping and box resizing."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ultragray.datasets.sweep import ByteArray
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.image_size import MAX_IMAGE_SIDE

MAX_PIXEL_BYTES = 4 << 30  # of the frames in a file


@dataclass(frozen=True)
class CropBox:
    """Half-open ranges of columns and rows of an image."""

    left: int
    right: int
    top: int
    bottom: int

    @property
    def width(self) -> int:
        return self.right - self.left

    @property
    def height(self) -> int:
        return self.bottom - self.top


def parse_crop(text: str | None, height: int, width: int) -> CropBox:
    """`"188:632,12:600"`: columns, rows, half open. None: the whole image. Raises InvalidArgument."""
    if text is None:
        return CropBox(0, width, 0, height)
    match = re.fullmatch(r"\s*(\d{0,9}):(\d{0,9})\s*,\s*(\d{0,9}):(\d{0,9})\s*", text)
    if match is None:
        raise InvalidArgument(
            f"crop must be columns and rows such as 188:632,12:600 (the ends are left out), got {text[:80]!r}",
            field="crop",
        )
    left, right, top, bottom = (
        int(group) if group else default for group, default in zip(match.groups(), (0, width, 0, height), strict=True)
    )
    if not (left < right <= width and top < bottom <= height):
        raise InvalidArgument(
            f"crop must lie within columns 0:{width} and rows 0:{height} and hold a pixel, got {text!r}",
            field="crop",
        )
    return CropBox(left, right, top, bottom)


def parse_image_size(text: str) -> tuple[int, int]:  # width, height
    """`"192x256"`: width, height. Raises InvalidArgument."""
    match = re.fullmatch(r"\s*(\d{1,9})\s*[xX×]\s*(\d{1,9})\s*", text)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(1 <= side <= MAX_IMAGE_SIDE for side in size):
        raise InvalidArgument(
            f"image_size must be width x height such as 192x256, each 1 to {MAX_IMAGE_SIDE}, got {text[:80]!r}",
            field="image_size",
        )
    return size


def resize_frames(images: ByteArray, width: int, height: int) -> ByteArray:  # [F, H, W] -> [F, height, width]
    """Each pixel the mean of the area it covers, so that the picture as a whole keeps its place."""
    if images.shape[1:] == (height, width):
        return images
    resized = np.empty((len(images), height, width), np.uint8)
    for image, out in zip(images, resized, strict=True):
        cv2.resize(np.ascontiguousarray(image), (width, height), dst=out, interpolation=cv2.INTER_AREA)
    return resized


def grey_frames(frames: npt.NDArray[Any], source: str) -> ByteArray:  # [F, H, W]
    """Frames [F, H, W], [F, H, W, 1|3|4] or [F, 1, H, W] as grey uint8 in memory.

    uint8 is taken as it is; floats must lie in [0, 1]. Colours become their luma (ITU-R BT.601), alpha is left out.
    Raises DatasetInvalid, naming the source and the frame.
    """
    if frames.dtype != np.uint8 and frames.dtype.kind != "f":
        raise DatasetInvalid(f"{source}: images must be uint8, or floats in [0, 1], got {frames.dtype}")
    if frames.shape[:1] == (0,):
        raise DatasetInvalid(f"{source}: it holds no frames")
    size = frame_size(frames.shape)
    if size is None:
        raise DatasetInvalid(
            f"{source}: images must be [N, H, W], [N, H, W, 1, 3 or 4] or [N, 1, H, W], got {list(frames.shape)}"
        )
    grey = np.empty((len(frames), *size), np.uint8)
    for number, (frame, out) in enumerate(zip(frames, grey, strict=True)):
        out[:] = _luma(_as_uint8(frame, number, source), size)
    return grey


def frame_size(shape: tuple[int, ...]) -> tuple[int, int] | None:
    """Height and width of frames stored in an array of this shape; None where it cannot hold frames."""
    if 0 in shape:
        return None
    if len(shape) == 3:
        return shape[1], shape[2]
    if len(shape) == 4 and shape[3] in (1, 3, 4):
        return shape[1], shape[2]
    if len(shape) == 4 and shape[1] == 1:
        return shape[2], shape[3]
    return None


def _as_uint8(frame: npt.NDArray[Any], number: int, source: str) -> ByteArray:
    if frame.dtype == np.uint8:
        return np.asarray(frame)
    if not np.isfinite(frame).all():
        raise DatasetInvalid(f"{source}: frame {number} holds NaN or infinity")
    low, high = float(frame.min()), float(frame.max())
    if low < 0.0 or high > 1.0:
        raise DatasetInvalid(
            f"{source}: frame {number} must be uint8 or lie in [0, 1], its values go from {low:g} to {high:g}"
        )
    return np.rint(np.asarray(frame, np.float64) * 255.0).astype(np.uint8)


def _luma(frame: ByteArray, size: tuple[int, int]) -> ByteArray:
    if frame.ndim == 3 and frame.shape[2] in (3, 4):
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(frame[:, :, :3]), cv2.COLOR_RGB2GRAY), np.uint8)
    return frame.reshape(size)
