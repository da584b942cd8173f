"""Slices of a scene, sampled and written into their requests' memory."""

from __future__ import annotations

import numpy as np

from ultragray.limits import Limits
from ultragray.scene import GaussianScene
from ultragray.settings import Encoding
from ultragray.volumes.fields import sample_slice
from ultragray.volumes.files import as_grey
from ultragray.volumes.plane import SliceView
from ultragray_workers.pool.memory import write_at
from ultragray_workers.pool.messages import RenderPart
from ultragray_workers.pool.process.encoding import encode_image


def write_slices(scene: GaussianScene, part: RenderPart[SliceView], memory: int, limits: Limits) -> int:
    """Samples the slices of a part and writes them in the place of their request's; the bytes of the whole reply.

    Raises GivenUp, FrameTooCostly, and InvalidArgument for labels of a scene without them.
    """
    view, size = part.settings, 0
    for number, pose in enumerate(part.poses, part.first):
        pixels = sample_slice(scene, view.field, view.grid(pose), limits)
        if view.encoding is Encoding.PNG:
            pixels = encode_image(as_grey(pixels, view.field), Encoding.PNG)
        data = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<"))
        write_at(memory, data.data.cast("B"), number * data.nbytes)
        size = part.total * data.nbytes
    return size
