"""Annotations burnt into the pixels of frames. Needs the extra `dicom`."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from PIL import Image

from ultragray.errors import InvalidArgument
from ultragray.exchange.exports.exporter import Annotation
from ultragray.geometry.probe import Picture
from ultragray.rendering.pixels import PixelArray

MAX_SIDE = 4096  # of an annotation's picture, and of what it becomes
MAX_PIXELS = 2**26  # of the pictures of all annotations, which are held at once
MAX_ENLARGED = 4


class AnnotatedPictures:
    """Frames [H, W] of one grid in mm, each with the pictures that lie over it.

    Where the pictures are finer than the frames, each pixel of those becomes k × k equal ones, so that letters can be
    read; `picture` is that grid. What is taller than a frame is a black band below it, as high in each of them.
    """

    def __init__(self, picture: Picture, annotations: Sequence[Annotation]) -> None:
        """Raises InvalidArgument for what is no PNG file, a large or a tall one, or more than MAX_PIXELS."""
        rest = MAX_PIXELS
        self._over: list[tuple[int, Image.Image]] = []
        for place, one in enumerate(annotations):
            self._over.append((one.frame, _decoded(one, f"annotations[{place}].picture", rest)))
            rest -= math.prod(self._over[-1][1].size)
        across, down = picture.step
        enlarged = [round(one.width / picture.width) for _, one in self._over]
        k = self._enlarged = min(MAX_ENLARGED, max([1, *enlarged]))
        first_x, first_z = picture.first[0] + across * (1 - k) / (2 * k), picture.first[1] + down * (1 - k) / (2 * k)
        self.picture = replace(
            picture,
            height=k * picture.height,
            width=k * picture.width,
            first=(first_x, first_z),
            step=(across / k, down / k),
        )
        self.rows = max([self.picture.height, *(self._rows(one) for _, one in self._over)])
        if self.rows > max(self.picture.height, MAX_SIDE):
            raise InvalidArgument(
                f"annotations must be at most {MAX_SIDE} rows tall when as wide as the frame, got {self.rows}",
                field="annotations",
            )

    def _rows(self, one: Image.Image) -> int:
        """The height of a picture as wide as the frame: its own pixels are square."""
        across, down = self.picture.step
        return max(1, round(one.height * self.picture.width / one.width * abs(across / down)))

    def burnt(self, pixels: PixelArray, frame: int) -> PixelArray:  # [H, W] uint8 -> [rows, k·W] uint8
        """The frame of a number, enlarged, with the pictures over it and the band below it."""
        enlarged = pixels.repeat(self._enlarged, axis=0).repeat(self._enlarged, axis=1)
        whole = np.zeros((self.rows, self.picture.width), np.uint8)
        whole[: len(enlarged)] = enlarged
        for own, one in self._over:
            if own == frame:
                placed = one.resize((self.picture.width, self._rows(one)))
                part = whole[: placed.height]
                grey, share = np.moveaxis(np.asarray(placed, np.float32), -1, 0)
                part[:] = np.rint(part + share / 255.0 * (grey - part))
        return whole


def _decoded(annotation: Annotation, path: str, max_pixels: int) -> Image.Image:
    """The picture of an annotation, grey and opacity."""
    try:
        image = Image.open(io.BytesIO(base64.b64decode(annotation.picture, validate=True)), formats=["PNG"])
        if max(image.size) <= MAX_SIDE and math.prod(image.size) <= max_pixels:
            return image.convert("LA")
    except (ValueError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise InvalidArgument(f"{path} must be a whole PNG file in base64", field=path) from error
    raise InvalidArgument(
        f"{path} must have at most {MAX_SIDE} rows and columns, and all together {MAX_PIXELS:,} pixels, it has "
        f"{image.size}",
        field=path,
    )
