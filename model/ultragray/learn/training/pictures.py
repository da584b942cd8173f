"""Pictures of a training on its way: one held-out frame, and how it is rendered at each validation."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray.files import write_whole
from ultragray.learn.evaluation.side_by_side import as_picture
from ultragray.learn.sweep import Sweep
from ultragray.rendering.pixels import png_file

FrameArray: TypeAlias = npt.NDArray[np.float32]
MAX_SIDE_PIXELS = 256
TRUTH = "validation_truth.png"


def write_picture(folder: Path, step: int, frame: Sweep, rendered: FrameArray) -> None:  # one frame, [H, W] in [0, 1]
    """Writes `validation_STEP.png`, and the frame itself once, with square pixels."""
    truth = folder / TRUTH
    if not truth.exists():
        _write(frame.images[0].astype(np.float32) / 255.0, frame, truth)
    _write(rendered, frame, folder / f"validation_{step:08d}.png")


def pictures_in(folder: Path) -> list[Path]:
    return sorted(folder.glob("validation_*.png"))


def _write(picture: FrameArray, frame: Sweep, path: Path) -> None:
    write_whole(path, png_file(as_picture(picture, frame, MAX_SIDE_PIXELS)))
