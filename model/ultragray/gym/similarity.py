"""How alike two frames are, as a reward: quick, and telling from afar."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

ByteImage = npt.NDArray[np.uint8]
COARSE = 8  # pixels of a side that are averaged


class Target:
    """A frame that others are compared with."""

    def __init__(self, frame: ByteImage) -> None:  # [H, W]
        self._fine, self._coarse = _standard(frame), _standard(_coarse(frame))

    def similarity(self, frame: ByteImage) -> float:  # [H, W]
        """The mean of two correlations, from −1 to 1: of the frames, and of their means over 8x8 pixels.

        The first tells a frame that is the target's from one beside it, the second the way to it from some millimetres
        away. That of a frame without contrast, such as one without contact, is 0.
        """
        fine = float(np.vdot(self._fine, _standard(frame)))
        coarse = float(np.vdot(self._coarse, _standard(_coarse(frame))))
        return min(1.0, 0.5 * (fine + coarse))  # rounding could take it beyond


def _coarse(frame: ByteImage) -> npt.NDArray[np.float32]:  # [H, W] -> [H/8, W/8]
    size = max(1, frame.shape[1] // COARSE), max(1, frame.shape[0] // COARSE)
    means = cv2.resize(frame.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(means, np.float32)


def _standard(frame: npt.NDArray[np.generic]) -> npt.NDArray[np.float32]:
    """With a mean of 0 and a length of 1; 0 where it has no contrast."""
    centred = frame.astype(np.float32)
    centred -= centred.mean()
    length = float(np.linalg.norm(centred))
    return centred / length if length > 0.0 else centred
