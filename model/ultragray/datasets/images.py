"""Images of any file as grey frames, what part of them is ultrasound, and how large a pixel is."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.geometry.image_size import MAX_IMAGE_SIDE
from ultragray.geometry.probe import FloatArray, LinearProbe
from ultragray.learn.sweep import ByteArray, ImageRegion, IntArray, frame_list

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


def eight_bits(stored: npt.NDArray[Any], source: str) -> tuple[ByteArray, tuple[str, ...]]:  # [F, …]
    """Frames of 8 or 16 bits as 8, and what is to be told of it.

    Of 16 bits the power of two above the largest value becomes 256, so that recordings of one scanner are scaled alike.
    Raises DatasetInvalid for values below 0.
    """
    if stored.dtype == np.uint8:
        return stored, ()
    if int(stored.min()) < 0:
        raise DatasetInvalid(
            f"{source}: 16-bit pixels must not be below 0, the smallest is {stored.min()}: RF data, not B-mode?"
        )
    surplus = max(0, int(stored.max()).bit_length() - 8)
    pixels = np.empty(stored.shape, np.uint8)
    for frame, out in zip(stored, pixels, strict=True):
        out[:] = frame >> surplus
    return pixels, (f"pixels of 16 bits were made 8: {(256 << surplus) - 1} became 255",)


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


# From the transforms of a tracked image to poses of a linear probe: docs/physics.md §1.
#
# The image's calibration gives the directions of its columns and rows and their sizes in mm, which need not be square
# nor exactly at a right angle.


SCALE_TOLERANCE = 1e-3  # relative; trackers write six digits
SMALLEST_ANGLE_DEG = 45.0
NEAR_SENSOR_MM = 1.0
SMALLEST_PIXEL_MM, LARGEST_PIXEL_MM, LARGEST_IMAGE_MM = 2e-3, 10.0, 1000.0


def poses_from_image_transforms(
    transforms: FloatArray, crop: CropBox, frame_numbers: IntArray, path: Path
) -> tuple[FloatArray, LinearProbe]:  # [F, 4, 4] pixels → tracker, mm
    """Poses [F, 4, 4] whose origin is the top centre of the crop, and the probe that spans the crop.

    The lateral axis x keeps the direction of the image's columns; the depth axis z is that of its rows made
    orthogonal to x (Gram–Schmidt); y = z × x, so that a calibration of either handedness gives a proper pose: the
    image's third axis is not used. Sizes are the lengths of the two columns in mm per pixel. Pixel (u, v) lies at
    integer coordinates, its edges half a pixel away. Raises DatasetInvalid, naming the frame, where the axes of the
    image are no plane or its scale changes.
    """
    columns, rows = transforms[:, :3, 0], transforms[:, :3, 1]
    scales = np.stack([np.linalg.norm(columns, axis=1), np.linalg.norm(rows, axis=1)], axis=1)  # [F, 2] mm
    usual = np.median(scales, axis=0)
    cosines = np.abs((columns * rows).sum(axis=1)) / scales.prod(axis=1)
    changed = np.abs(scales / usual - 1.0).max(axis=1) > SCALE_TOLERANCE
    if changed.any():
        others = ", ".join(dict.fromkeys(f"{size[0]:.5g} x {size[1]:.5g}" for size in scales[changed][:5]))
        raise DatasetInvalid(
            f"{path}: frame {frame_list(frame_numbers[changed])}: a pixel is {others} mm, in other frames "
            f"({frame_list(frame_numbers[~changed])}) {usual[0]:.5g} x {usual[1]:.5g}: was the depth changed? Choose "
            "frames of one size with frames"
        )
    for number, cosine in zip(frame_numbers, cosines, strict=True):
        if not cosine < np.cos(np.radians(SMALLEST_ANGLE_DEG)):
            raise DatasetInvalid(f"{path}: frame {number}: columns and rows of the image are nearly parallel")
    x = columns / scales[:, :1]
    z = rows - (rows * x).sum(axis=1, keepdims=True) * x
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(transforms), 1, 1))
    poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2] = x, np.cross(z, x), z
    top_centre = np.array([(crop.left + crop.right - 1) / 2, crop.top - 0.5, 0.0, 1.0])
    poses[:, :3, 3] = (transforms @ top_centre)[:, :3]
    width_mm, depth_mm = (round(float(size), 9) for size in usual * (crop.width, crop.height))
    return poses, LinearProbe(width_mm=width_mm, near_mm=0.0, far_mm=depth_mm)


def check_pixel_mm(pixel_mm: tuple[float, float], side: int, where: str) -> None:
    """Raises DatasetInvalid, naming `where`, for the size (lateral, axial) of a pixel that no image has whose shorter
    side has so many pixels."""
    low, high = min(pixel_mm), max(pixel_mm)
    if low < SMALLEST_PIXEL_MM or (high > LARGEST_PIXEL_MM and high * side > LARGEST_IMAGE_MM) or not low < np.inf:
        unit = ": lengths in metres?" if 0 < high < SMALLEST_PIXEL_MM else ""
        raise DatasetInvalid(
            f"{where} makes a pixel {pixel_mm[0]:.5g} x {pixel_mm[1]:.5g} mm (width x height), it must be "
            f"{SMALLEST_PIXEL_MM:g} to {LARGEST_PIXEL_MM:g} mm{unit}"
        )


def near_sensor(image_to_sensor: FloatArray | None) -> Iterator[str]:  # [4, 4]
    """What is odd about a calibration whose first pixel lies within a millimetre of the sensor, but not within a pixel:
    a translation in metres is so."""
    if image_to_sensor is None:
        return
    away_mm = float(np.linalg.norm(image_to_sensor[:3, 3]))
    in_pixels = np.linalg.lstsq(image_to_sensor[:3, :2], image_to_sensor[:3, 3], rcond=None)
    is_half = np.abs(in_pixels[0] * 2 - np.round(in_pixels[0] * 2)).max() < 1e-3 and not in_pixels[1].sum() > 1e-9
    if 0.0 < away_mm < NEAR_SENSOR_MM and not is_half:
        yield (
            f"the calibration puts the first pixel {away_mm:.3g} mm from the sensor: is its translation in metres, and "
            "its pixels in millimetres?"
        )


def pixel_size_mm(transforms: FloatArray) -> tuple[float, float]:  # [F, 4, 4] pixels → mm
    """Lateral and axial size of a pixel."""
    lateral_mm, axial_mm = np.median(np.linalg.norm(transforms[:, :3, :2], axis=1), axis=0).tolist()
    return lateral_mm, axial_mm


def region_of(
    size: tuple[int, ...],
    box: CropBox,
    pixel_mm: tuple[float, float],  # lateral, axial
    calibration: FloatArray | None,  # [4, 4]
) -> ImageRegion:
    """The region of a crop in images of (rows, columns)."""
    return ImageRegion(
        image_width=size[1],
        image_height=size[0],
        left=box.left,
        top=box.top,
        width=box.width,
        height=box.height,
        lateral_mm=pixel_mm[0],
        axial_mm=pixel_mm[1],
        image_to_probe=() if calibration is None else tuple(calibration.ravel().tolist()),
    )
