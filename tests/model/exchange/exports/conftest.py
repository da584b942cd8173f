"""Five poses, and one way to write frames of them."""

import numpy as np
import torch

from ultragray.exchange.exports import FORMATS, ExportHeader, export_to
from ultragray.rendering.frames import show

POSES = np.tile(np.eye(4), (5, 1, 1))
POSES[:, 1, 3] = np.arange(5) / 3.0


def header_of(format, settings, *, dtype="uint8", poses=POSES, scene_sha256="0" * 64):
    return ExportHeader(FORMATS[format].shown(settings), dtype, poses, "one", scene_sha256, "ultragray/0 cpu")


def exported(path, format, header, frames, told):
    """Writes frames, [C, H, W] by output, as they are shown, in portions of two."""
    given = {name: torch.from_numpy(np.array(values)) for name, values in frames.items()}
    shown = show(given, header.settings.probe, header.settings.display)
    with export_to(path, format, header) as add:
        for first in range(0, len(told), 2):
            add({name: values[first : first + 2].numpy() for name, values in shown.items()}, told[first : first + 2])
