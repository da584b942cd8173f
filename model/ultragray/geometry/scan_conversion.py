"""Scan conversion: frames, one column a scan line, as pictures of the image plane with square pixels. Free of torch.

Interpolation is bilinear, pixels outside the image are 0. `frames.show` does the same where the frames are tensors.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray.geometry.probe import FloatArray, Probe

FloatImage: TypeAlias = npt.NDArray[np.float32]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
IntArray: TypeAlias = npt.NDArray[np.int64]
Interpolate: TypeAlias = Callable[[npt.NDArray[Any], int, FloatArray, FloatArray], FloatArray]
_NOT_ONE_MORE = 1.0 + 1e-9  # pixel, by rounding


def scan_convert(frame: npt.NDArray[Any], probe: Probe, pixel_mm: float) -> FloatImage:  # [H, W] -> [H', W']
    """A frame as the picture `probe.picture(pixel_mm)`."""
    inside, here, below, beside, down, right = _pixels(probe, frame.shape, pixel_mm)
    values = frame.ravel().astype(np.float32, copy=False)
    upper, lower = values.take(here), values.take(here + below)
    upper += (values.take(here + beside) - upper) * right
    lower += (values.take(here + below + beside) - lower) * right
    picture = np.zeros(inside.shape, np.float32)
    picture[inside] = upper + (lower - upper) * down
    return picture


@lru_cache(maxsize=1)  # one frame after another has the same
def _pixels(probe: Probe, shape: tuple[int, int], pixel_mm: float) -> tuple[npt.NDArray[Any], ...]:
    """Of a picture: which pixels [H', W'] lie in a frame; of each that does its sample, the steps to those below and
    beside it, and its shares of them.
    """
    rows, columns, inside = samples(probe, shape, pixel_mm)
    rows, columns = rows[inside], columns[inside]
    i, j = np.floor(rows).astype(np.int32), np.floor(columns).astype(np.int32)
    down, right = (rows - i).astype(np.float32), (columns - j).astype(np.float32)
    height, width = shape
    j %= width  # of scan lines all the way round the last is before the first
    below = np.where(i < height - 1, width, 0).astype(np.int32)
    beside = np.where(j < width - 1, 1, 1 - width).astype(np.int32)
    return inside, i * width + j, below, beside, down, right


def with_square_pixels(frame: FloatImage, probe: Probe, longer_side: int) -> FloatImage:  # [H, W] -> [H', W']
    """A frame as a picture whose longer side has `longer_side` pixels."""
    return scan_convert(frame, probe, probe.box_mm.longer_side / longer_side * _NOT_ONE_MORE)


def samples(
    probe: Probe, shape: tuple[int, ...], pixel_mm: float
) -> tuple[FloatArray, FloatArray, BoolArray]:  # [H', W'] each
    """Row and column of each pixel of a picture in a frame of `shape` [H, W], and whether it lies in the frame."""
    x, z = probe.picture(pixel_mm).positions_mm()
    rows, columns = probe.image_coordinates(x, z)
    inside = ~np.isnan(rows)
    return *pixel_places(probe, shape, np.where(inside, rows, 0.0), np.where(inside, columns, 0.0)), inside


def pixel_places(
    probe: Probe, shape: tuple[int, ...], rows: FloatArray, columns: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Image coordinates, from 0 to 1, in rows and columns of a frame of `shape` [H, W], none beyond its outer pixels.

    Columns of scan lines that go all the way round lie from −½ to W − ½: the first follows the last.
    """
    height, width = shape
    i, j = np.clip(rows * height - 0.5, 0, height - 1), columns * width - 0.5
    return i, j if probe.lines.wrap else np.clip(j, 0, width - 1)


def interpolated(frame: npt.NDArray[Any], rows: FloatArray, columns: FloatArray) -> FloatArray:
    """A frame [H, W] between its pixels, at places as `pixel_places` gives them."""
    return interpolated_frames(frame[None], 0, rows, columns)


def interpolated_frames(
    frames: npt.NDArray[Any], which: IntArray | int, rows: FloatArray, columns: FloatArray
) -> FloatArray:  # [F, H, W], [...] each -> [...]
    """Frames between their pixels, each place in the frame whose number `which` gives."""
    _, height, width = frames.shape
    i, j = np.floor(rows).astype(np.intp), np.floor(columns).astype(np.intp)
    down, right = rows - i, columns - j
    pixels = frames.reshape(-1)  # one index is looked up in a third of the time of three
    first = which * (height * width)
    row, below = first + i * width, first + np.minimum(i + 1, height - 1) * width
    beside, j = np.where(j + 1 == width, 0, j + 1), np.where(j < 0, width - 1, j)  # all the way round, -1 is the last
    left = 1 - right
    upper = pixels[row + j] * left + pixels[row + beside] * right
    lower = pixels[below + j] * left + pixels[below + beside] * right
    values: FloatArray = upper * (1 - down) + lower * down
    return values


def interpolated_sharply(
    frames: npt.NDArray[Any], which: int, rows: FloatArray, columns: FloatArray
) -> FloatArray:  # [F, H, W], [P] each -> [P]
    """A frame between its pixels by cubic polynomials, which blur less than `interpolated_frames` does."""
    import cv2

    if not len(rows):
        return np.zeros(0)
    x, y = (some.astype(np.float32)[None] for some in (columns, rows))  # a column would take ten times as long as a row
    values = cv2.remap(frames[which].astype(np.float32), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values[0], np.float64)
