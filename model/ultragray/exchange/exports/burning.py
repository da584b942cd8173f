"""Annotations burnt into the pixels of frames. Needs the extra `dicom`."""

from __future__ import annotations

import base64
import binascii
import io
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from PIL import Image, UnidentifiedImageError

from ultragray.errors import InvalidArgument
from ultragray.exchange.exports.exporter import Annotation
from ultragray.geometry.probe import Picture
from ultragray.rendering.pixels import PixelArray

MAX_SIDE = 4096  # of an annotation's picture
MAX_ENLARGED = 4


class AnnotatedPictures:
    """Frames [H, W] of one grid in mm, each with the pictures that lie over it.

    Where the pictures are finer than the frames, each pixel of those becomes k × k equal ones, so that letters can be
    read; `picture` is that grid. What is taller than a frame is a black band below it, as high in each of them.
    """

    def __init__(self, picture: Picture, annotations: Sequence[Annotation]) -> None:
        """Raises InvalidArgument for what is no PNG file, or a large one."""
        over = [(one.frame, _decoded(one, place)) for place, one in enumerate(annotations)]
        across, down = picture.step
        enlarged = [round(one.width / picture.width) for _, one in over]
        k = self._enlarged = min(MAX_ENLARGED, max([1, *enlarged]))
        first_x, first_z = picture.first[0] + across * (1 - k) / (2 * k), picture.first[1] + down * (1 - k) / (2 * k)
        self.picture = replace(
            picture,
            height=k * picture.height,
            width=k * picture.width,
            first=(first_x, first_z),
            step=(across / k, down / k),
        )
        width, self.rows = self.picture.width, self.picture.height
        self._over: list[tuple[int, Image.Image]] = []
        for frame, one in over:
            rows = max(1, round(one.height * width / one.width * abs(across / down)))  # its own pixels are square
            self._over.append((frame, one.resize((width, rows))))
            self.rows = max(self.rows, rows)

    def burnt(self, pixels: PixelArray, frame: int) -> PixelArray:  # [H, W] uint8 -> [rows, k·W] uint8
        """The frame of a number, enlarged, with the pictures over it and the band below it."""
        enlarged = pixels.repeat(self._enlarged, axis=0).repeat(self._enlarged, axis=1)
        whole = np.zeros((self.rows, self.picture.width), np.uint8)
        whole[: len(enlarged)] = enlarged
        for own, one in self._over:
            if own == frame:
                part = whole[: one.height]
                grey, share = np.moveaxis(np.asarray(one, np.float32), -1, 0)
                part[:] = np.rint(part + share / 255.0 * (grey - part))
        return whole


def _decoded(annotation: Annotation, place: int) -> Image.Image:
    """The picture of an annotation, grey and opacity."""
    path = f"annotations[{place}].picture"
    try:
        image = Image.open(io.BytesIO(base64.b64decode(annotation.picture, validate=True)), formats=["PNG"])
        if max(image.size) > MAX_SIDE:
            raise InvalidArgument(f"{path} must have at most {MAX_SIDE} rows and columns, got {image.size}", field=path)
        return image.convert("LA")
    except (binascii.Error, UnidentifiedImageError, OSError, SyntaxError) as error:
        raise InvalidArgument(f"{path} must be a PNG file in base64: {error}", field=path) from error
