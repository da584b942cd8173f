"""Many pictures of one size in one NumPy file, uint8 [F, H, W], read one at a time. Reading is free of torch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from ultragray.datasets.sweep import Sweep

SUFFIX = ".npy"


def write_stack(path: Path, frames: npt.NDArray[Any], sweep: Sweep) -> None:
    """Writes frames [F, H, W] (uint8, or floats in [0, 1]) with square pixels, those of convex and phased probes as
    fans."""
    from ultragray.side_by_side import as_picture

    scale = 255.0 if frames.dtype == np.uint8 else 1.0
    stack: npt.NDArray[np.uint8] | None = None
    for place, frame in enumerate(frames):
        picture = as_picture((frame / scale).astype(np.float32), sweep)
        if stack is None:
            stack = np.lib.format.open_memmap(path, "w+", np.uint8, (len(frames), *picture.shape))
        stack[place] = picture
    if stack is None:
        np.save(path, np.zeros((0, sweep.height, sweep.width), np.uint8))


def read_picture(path: Path, index: int) -> npt.NDArray[np.uint8] | None:  # [H, W]
    """One picture; None where the file, or the place in it, is not there."""
    try:
        stack = np.load(path, mmap_mode="r")
    except FileNotFoundError:
        return None
    return np.array(stack[index]) if 0 <= index < len(stack) else None
