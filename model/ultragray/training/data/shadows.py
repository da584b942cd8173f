"""The shadows that training frames show: the evidence for what absorbs.

Darkness can be tissue without echo or a beam that has been spent. A shadow lies below something that reflects, and it
lasts to the end of the scan line, while other lines show echoes at these depths. So the share of the beam that is left
is at most what the brightest place from here down reaches of what is usual at its depth. Where a whole depth is dark in
every frame, and along lines that are dark from the face on, which have no contact, there is no evidence, and the share
is 1.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from ultragray.datasets.sweep import Sweep, spread_places

USUAL = 0.7  # quantile over all scan lines at a depth: brighter than most shadows, less than a reflector
LEAST_USUAL = 0.03  # grey value, of 1, below which a depth tells nothing
SMOOTHING_MM = 0.7, 1.0  # standard deviation across the scan lines and along them: speckle is no evidence
LEAST_LENGTH_MM, LEAST_LENGTH = 5.0, 0.1  # of a shadow; the latter of the scan line
FACE_MM = 1.0  # within which a line in contact is bright
NO_CONTACT = 0.05  # of the usual brightness: a scan line that nowhere has more shows nothing at all
SHADOWED = 0.9  # of the beam left, or less
SPENT = 0.2  # of the beam left, below which noise outweighs the echo

LOOKED_AT_FRAMES = 64  # for what is usual

FloatImage = npt.NDArray[np.float32]


class Beam(NamedTuple):
    """The evidence of one frame."""

    left: FloatImage  # [H, W] share of the beam, at most
    echo: FloatImage  # [H, W] the smoothed brightness that the whole beam would have shown there

    @property
    def is_shadowed(self) -> npt.NDArray[np.bool_]:  # [H, W]
        return self.left < SHADOWED


class Shadows:
    """The evidence in the frames of a sweep, frame by frame."""

    def __init__(self, sweep: Sweep) -> None:
        self._sweep = sweep
        self._axial, self._lateral = sweep.pixel_mm
        some = np.stack([self._smooth(place) for place in spread_places(len(sweep), LOOKED_AT_FRAMES)])
        self._usual = _usual_by_depth(some)  # [H] brightness
        (self._bright_rows,) = np.nonzero(self._usual > LEAST_USUAL)
        self._usual_below = _usual_by_depth(self._brightest_below(self._relative(some)))  # [H]

    def of(self, place: int) -> Beam:
        """The evidence of the frame at a place of the sweep."""
        height, width = self._sweep.height, self._sweep.width
        if not len(self._bright_rows):
            return Beam(np.ones((height, width), np.float32), np.zeros((height, width), np.float32))
        relative = self._relative(self._smooth(place)[None])
        below = self._brightest_below(relative)[0] / np.maximum(self._usual_below, 1e-6)[:, None]
        last = max(0, int(self._bright_rows[-1] - max(LEAST_LENGTH_MM / self._axial, LEAST_LENGTH * height)))
        below[last:] = below[last]  # too little is left of the line to tell
        at_face = below[: max(1, round(FACE_MM / self._axial))].max(axis=0)
        left = np.clip(below / np.maximum(at_face, NO_CONTACT), 0.0, 1.0)
        left[:, at_face < NO_CONTACT] = 1.0
        echo = np.where(left < SPENT, 1.0, np.minimum(relative[0] / np.maximum(left, SPENT), 1.0))
        return Beam(left, (self._usual[:, None] * echo).astype(np.float32))

    def pixels(self) -> npt.NDArray[np.bool_]:  # [F, H, W]
        """Which pixels of all frames lie in a shadow."""
        found = np.empty(self._sweep.images.shape, bool)
        for place, pixels in enumerate(found):
            pixels[:] = self.of(place).is_shadowed
        return found

    def _smooth(self, place: int) -> FloatImage:  # [H, W]
        sigmas = [max(0.5, mm / pixel) for mm, pixel in zip(SMOOTHING_MM, (self._lateral, self._axial), strict=True)]
        image = self._sweep.images[place] / np.float32(255.0)
        smooth: FloatImage = cv2.GaussianBlur(
            image, (0, 0), sigmas[0], sigmaY=sigmas[1], borderType=cv2.BORDER_REPLICATE
        )
        return smooth

    def _relative(self, smooth: FloatImage) -> FloatImage:  # [F, H, W] both
        """Brightness over what is usual at its depth; 0 where the depth tells nothing."""
        relative = np.zeros_like(smooth)
        relative[:, self._bright_rows] = smooth[:, self._bright_rows] / self._usual[self._bright_rows, None]
        return relative

    @staticmethod
    def _brightest_below(relative: FloatImage) -> FloatImage:  # [F, H, W] both
        """The largest value from each pixel down its scan line."""
        return np.maximum.accumulate(relative[:, ::-1], axis=1)[:, ::-1].copy()


def _usual_by_depth(images: FloatImage) -> FloatImage:  # [F, H, W] -> [H]
    return np.array([np.quantile(images[:, row], USUAL) for row in range(images.shape[1])], np.float32)
