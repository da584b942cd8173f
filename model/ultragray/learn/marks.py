"""Text, rulers and logos that a scanner burns into images: bright pixels that never change while others do. A recording
that has some is told so (`datasets.checks`), and they say nothing of how images move (`training.agreement`).
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
import numpy.typing as npt

from ultragray.learn.sweep import ByteArray

LEAST_PICTURES = 8  # of which changes and marks can be told
STILL, BRIGHT = 6, 40  # levels: JPEG keeps text so
LEAST_ALIVE = 0.2  # of the pixels beside marks
CONTRAST = 2.0  # to the darkest of the pixels around: the bright band below a probe's face has less


def burnt_in(images: Iterable[ByteArray], count: int) -> list[npt.NDArray[np.bool_]]:
    """The marks [H, W] that so many images have in common, the largest first."""
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
    groups, labels = cv2.connectedComponents(grown, connectivity=8)
    found = [marks & (labels == label) for label in range(1, groups)]
    return sorted((mark for mark in found if _stands_out(mark, marks, low)), key=np.count_nonzero, reverse=True)


def _stands_out(mark: npt.NDArray[np.bool_], marks: npt.NDArray[np.bool_], low: ByteArray) -> bool:
    around = (cv2.dilate(mark.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~marks
    return not around.any() or float(low[mark].mean()) >= CONTRAST * float(np.median(low[around]))
