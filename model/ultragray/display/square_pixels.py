"""Frames in the proportions of what they show. Free of torch."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from ..probe import LinearProbe, Probe

FloatImage = npt.NDArray[np.float32]
_NOT_ONE_MORE = 1.0 + 1e-9  # pixel, by rounding


def with_square_pixels(frame: FloatImage, probe: Probe, longer_side: int) -> FloatImage:  # [H, W] -> [H', W']
    """A frame with `longer_side` square pixels along its longer side; those of convex and phased probes are fans."""
    width_mm, _, height_mm = np.ptp(probe.corners_mm(), axis=0).tolist()
    pixel_mm = max(width_mm, height_mm) / longer_side * _NOT_ONE_MORE
    if not isinstance(probe, LinearProbe):
        return probe.scan_convert(frame, pixel_mm)
    size = (max(1, round(width_mm / pixel_mm)), max(1, round(height_mm / pixel_mm)))
    return cv2.resize(frame, size, interpolation=cv2.INTER_LINEAR).astype(np.float32)
