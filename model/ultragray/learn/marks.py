"""Text, rulers and logos that a scanner burns into images: bright pixels that never change while others do. A recording
that has some is told so (`datasets.checks`), and they say nothing of how images move (`training.agreement`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from ultragray.learn.sweep import ByteArray

LEAST_PIXELS = 4  # of a mark, such as a tick of a ruler: fewer stay the same by chance
LEAST_PICTURES = 8  # of which changes and marks can be told
STILL, BRIGHT = 6, 40  # levels: JPEG keeps text so
LEAST_ALIVE = 0.2  # of the pixels beside marks
CONTRAST = 2.0  # to the darkest of the pixels around: the bright band below a probe's face has less


class Mark(NamedTuple):
    """A mark, and where its box lies in the images."""

    top: int
    left: int
    pixels: npt.NDArray[np.bool_]  # [h, w] of its box

    @property
    def box(self) -> tuple[slice, slice]:
        height, width = self.pixels.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)


def burnt_in(images: Iterable[ByteArray], count: int) -> list[Mark]:
    """The marks that so many images [H, W] have in common, the largest first."""
    low = high = None
    for image in images if count >= LEAST_PICTURES else ():
        low = image.copy() if low is None else np.minimum(low, image, out=low)
        high = image.copy() if high is None else np.maximum(high, image, out=high)
    if low is None or high is None:
        return []
    span = high.astype(np.int16) - low
    marks = (span <= STILL) & (low >= BRIGHT)
    if marks.all() or np.mean(span[~marks] > 2 * STILL) < LEAST_ALIVE:
        return []
    grown = cv2.dilate(marks.astype(np.uint8), np.ones((5, 9), np.uint8))
    _, labels, parts, _ = cv2.connectedComponentsWithStats(grown, connectivity=8)
    result = []
    for label, (left, top, width, height, _) in enumerate(parts[1:].tolist(), start=1):
        box = np.s_[top : top + height, left : left + width]
        mark = marks[box] & (labels[box] == label)
        if np.count_nonzero(mark) >= LEAST_PIXELS and _stands_out(mark, marks[box], low[box]):
            result.append(Mark(top, left, mark))
    return sorted(result, key=lambda mark: np.count_nonzero(mark.pixels), reverse=True)


def _stands_out(mark: npt.NDArray[np.bool_], marks: npt.NDArray[np.bool_], low: ByteArray) -> bool:
    around = (cv2.dilate(mark.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~marks
    return not around.any() or float(low[mark].mean()) >= CONTRAST * float(np.median(low[around]))
