"""UltrasoundImageOrientation of PLUS: where a stored image's axes point.

Two letters say where the columns and then the rows of the stored image go: M or U, towards the marked or the unmarked
side of the probe; F or N, away from the transducer (far) or towards it (near). FM: depth goes along a row.
A third letter, A or D, is about stacks of slices and does not matter here. XX or nothing: unknown, taken as MF.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ultragray.datasets.sweep import ByteArray
from ultragray.errors import DatasetInvalid

UNKNOWN = ("", "XX")


def orient_frames(frames: ByteArray, orientation: str, path: Path) -> ByteArray:
    """Stored frames [F, rows, columns] as MF: columns towards the marked side (x), rows away from the probe (z).

    PLUS calibrates, and so defines the frame `Image` of its transforms, on images brought to MF. Raises DatasetInvalid
    for an orientation that no 2D image has.
    """
    if orientation in UNKNOWN:
        return frames
    if not re.fullmatch(r"([MU][FN]|[FN][MU])[AD]?", orientation):
        raise DatasetInvalid(
            f"{path}: UltrasoundImageOrientation must be MF, MN, UF, UN, FM, NM, FU or NU, and A or D, or XX, got "
            f"{orientation[:20]!r}"
        )
    lateral, depth = orientation[0], orientation[1]
    if lateral in "FN":  # the image is transposed
        frames = np.swapaxes(frames, 1, 2)
        lateral, depth = depth, lateral
    if lateral == "U":
        frames = frames[:, :, ::-1]
    if depth == "N":
        frames = frames[:, ::-1]
    return frames
