"""Frames in a folder, uint8 [F, H, W] by name, as their probe samples them; read one at a time, as pictures.

Free of torch.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray.contract import from_dict, to_dict
from ultragray.display.pixels import to_uint8
from ultragray.display.scan_conversion import with_square_pixels
from ultragray.probe import Probe

PROBE_NAME, SUFFIX = "probe.json", ".npy"
PICTURE_SIDE = 512  # pixels, the longer one


def write_stacks(folder: Path, stacks: Mapping[str, npt.NDArray[Any]], probe: Probe) -> None:
    """Writes frames of one probe, [F, H, W], uint8 or float32 in [0, 1]."""
    (folder / PROBE_NAME).write_text(json.dumps(to_dict(probe)), encoding="utf-8")
    for name, frames in stacks.items():
        with (folder / f"{name}{SUFFIX}").open("wb") as file:
            header = {"descr": "|u1", "fortran_order": False, "shape": frames.shape}
            np.lib.format.write_array_header_1_0(file, header)
            for frame in frames:  # np.save does not tell that a disk is full
                file.write(np.ascontiguousarray(to_uint8(frame)).data)


def read_picture(folder: Path, name: str, index: int) -> npt.NDArray[np.uint8] | None:  # [H', W']
    """One frame with square pixels, scan-converted; None where it is not there."""
    try:
        stack = np.load(folder / f"{name}{SUFFIX}", mmap_mode="r")
        probe = from_dict(Probe, json.loads((folder / PROBE_NAME).read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
    if not 0 <= index < len(stack):
        return None
    drawn = with_square_pixels(stack[index].astype(np.float32), probe, PICTURE_SIDE)
    return np.rint(drawn).astype(np.uint8)
