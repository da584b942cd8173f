"""Frames as video, which is a fraction of the size of images: VP9 by libvpx, of PyAV. The extra `video`."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray.contract import shown
from ultragray.errors import InvalidArgument
from ultragray.installation import missing_extra
from ultragray_service.igtl.contents import Image, VideoFrame

VP9 = "VP90"  # in the protocol's list of codecs

_GREY = 128  # of both planes of colour
_TICKS = Fraction(1, 1000)
_KEY_EVERY = 50  # frames: who records a stream can begin to read it there
_SETTINGS = {"deadline": "realtime", "cpu-used": "8", "lag-in-frames": "0", "crf": "24"}


class VideoEncoder:
    """An encoder of one stream: what it gives is read in order, from the first frame on. For one thread at a time."""

    def __init__(self, codec: str = VP9) -> None:
        """Raises InvalidArgument for another codec than VP90, ExtraMissing."""
        if codec not in ("", VP9):
            raise InvalidArgument(f"the codec must be {VP9} (VP9), got {shown(codec)}", field="codec")
        try:
            import av
        except ImportError as error:
            raise missing_extra(error, "VIDEO") from error
        self._av = av
        self._context: Any = None  # of frames of one size
        self._count = 0

    def encode(self, image: Image) -> VideoFrame:
        """The next frame of the stream: a key frame where it is the first of its size."""
        rows, columns = image.pixels.shape
        if self._context is None or (self._context.width, self._context.height) != (columns, rows):
            self._context = self._opened(columns, rows)
        frame = self._av.VideoFrame(columns, rows, self._context.pix_fmt)
        luminance, *colours = frame.planes
        luminance.update(_padded(image.pixels, luminance.line_size))
        for plane in colours:
            plane.update(bytes([_GREY]) * plane.buffer_size)
        frame.pts = self._count
        self._count += 1
        (packet,) = self._context.encode(frame)  # no frame waits for another one
        return VideoFrame(VP9, bytes(packet), packet.is_keyframe, (columns, rows), image.matrix)

    def _opened(self, columns: int, rows: int) -> Any:
        context = self._av.CodecContext.create("libvpx-vp9", "w")
        context.width, context.height, context.pix_fmt = columns, rows, "yuv420p"
        context.time_base, context.bit_rate, context.gop_size, context.thread_count = _TICKS, 0, _KEY_EVERY, 1
        context.options = dict(_SETTINGS)
        return context


def _padded(pixels: npt.NDArray[np.uint8], line_bytes: int) -> bytes:  # [H, W]
    return np.pad(pixels, ((0, 0), (0, line_bytes - pixels.shape[1]))).tobytes()
