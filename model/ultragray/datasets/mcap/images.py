"""Images of ROS 2 as grey frames: sensor_msgs/Image, and CompressedImage with a JPEG or PNG file in it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from ultragray.datasets.images import grey_frames
from ultragray.datasets.sweep import ByteArray
from ultragray.errors import DatasetInvalid
from ultragray.interchange.ros_fields import COMPRESSED
from ultragray.interchange.ros_messages import IMAGE

KINDS = (IMAGE, COMPRESSED)
_FLAGS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION

# Channels, and the place of red, green and blue among them; a float is of 0 to 1.
_ENCODINGS: dict[str, tuple[int, tuple[int, ...]]] = {
    "mono8": (1, (0,)),
    "8UC1": (1, (0,)),
    "32FC1": (1, (0,)),
    "rgb8": (3, (0, 1, 2)),
    "rgba8": (4, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)),
    "bgra8": (4, (2, 1, 0)),
    "8UC4": (4, (2, 1, 0)),
}


def grey_image(message: Any, kind: str, where: str) -> ByteArray:  # [H, W]
    """The pixels of a message; colours become their luma. Raises DatasetInvalid, naming `where`."""
    if kind == COMPRESSED:
        return _decompressed(message, where)
    known = _ENCODINGS.get(message.encoding)
    if known is None:
        raise DatasetInvalid(
            f"{where}: its encoding must be one of {', '.join(_ENCODINGS)}, got {message.encoding[:40]!r}"
        )
    channels, colours = known
    pixel = np.dtype((">" if message.is_bigendian else "<") + "f4") if message.encoding == "32FC1" else np.dtype("u1")
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * channels * pixel.itemsize
    data = np.frombuffer(message.data, np.uint8)
    if min(height, width) < 1 or step < row_bytes or len(data) < (height - 1) * step + row_bytes:
        raise DatasetInvalid(
            f"{where}: {height} rows of {step} bytes must hold {width} pixels of {message.encoding}, it has "
            f"{len(data)} bytes"
        )
    rows = np.lib.stride_tricks.as_strided(data, (height, row_bytes), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows).view(pixel).reshape(height, width, channels)[:, :, colours]
    frame: ByteArray = grey_frames(pixels[None], where)[0]
    return frame


def _decompressed(message: Any, where: str) -> ByteArray:
    data = np.frombuffer(message.data, np.uint8)
    try:
        found = cv2.imdecode(data, _FLAGS) if len(data) else None
    except cv2.error:
        found = None
    if found is None:
        raise DatasetInvalid(
            f"{where}: it must hold a JPEG or PNG file, got {len(data)} bytes of format {message.format[:40]!r}"
        )
    return np.asarray(found, np.uint8)
