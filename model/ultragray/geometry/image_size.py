"""Sizes of images, [H, W] pixels: H depth samples, W scan lines."""

from __future__ import annotations

from typing import Any

import numpy as np

from ultragray.errors import InvalidImageSize

MAX_IMAGE_SIDE = 4096
DEFAULT_IMAGE_SIDE = 512  # of a scene that does not know the size of its training images


def check_image_size(height: Any, width: Any, *, limit: int = MAX_IMAGE_SIDE) -> None:
    """Raises InvalidImageSize unless both sides are integers from 1 to `limit`."""
    for name, value in (("height", height), ("width", width)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 1 <= value <= limit:
            raise InvalidImageSize(f"{name} must be an integer from 1 to {limit}, got {value!r}", field=name)
