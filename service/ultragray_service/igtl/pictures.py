"""From a rendered frame to an image with its place in space."""

from __future__ import annotations

import numpy as np

from ultragray_workers.pool.types import RenderResult

from .contents import Image

_SLICE_MM = 1.0  # nominal thickness: an image of one slice has none


def image_of(result: RenderResult) -> Image:
    """The frame of a result of one pose, uint8 and B-mode with pixels in mm, as an image in the frame of its pose.

    i runs along lateral x, j along depth z, k against elevation y, so that i, j, k is right-handed.
    """
    picture = result.settings.picture
    in_probe = np.zeros((4, 4))  # pixel→probe
    in_probe[0, 0], in_probe[2, 1] = picture.step
    in_probe[1, 2] = -_SLICE_MM
    in_probe[:, 3] = (picture.first[0], 0.0, picture.first[1], 1.0)
    pixels = np.frombuffer(result.data, np.uint8).reshape(picture.height, picture.width)
    return Image(pixels, result.poses[0] @ in_probe)
