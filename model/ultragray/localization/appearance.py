"""What of a frame is compared: its structures at some size, whatever gain and shadow made of their brightness.

A frame is smoothed, its mean over a wider neighbourhood is taken off, and what is left is divided by its own strength
there. Coarse structures match from far away, fine ones tell the place exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

from ultragray.evaluation.compounding import pixel_positions_mm
from ultragray.probe import Probe

NEIGHBOURHOOD = 3.0  # times as wide as the smoothing
LEAST_STRENGTH = 0.02  # of grey values in [0, 1]: what varies less is noise
REACH = 2.5  # standard deviations of a Gaussian that are summed
LEAST_SIGMA = 0.3  # pixels: less smooths nothing


@dataclass(frozen=True)
class Scale:
    """Frames of `rows` x `columns` pixels, smoothed by Gaussians of `sigma_rows` and `sigma_columns` pixels."""

    rows: int
    columns: int
    sigma_rows: float
    sigma_columns: float

    @classmethod
    def of(cls, probe: Probe, rows: int, columns: int, smoothing_mm: float) -> Scale:
        """Smoothed by so many mm along depth, and across in the middle of the image."""
        middle = pixel_positions_mm(probe, rows, columns).reshape(rows, columns, 3)[rows // 2]
        across_mm = float(((middle[1:] - middle[:-1]) ** 2).sum(axis=1).mean() ** 0.5)
        return cls(rows, columns, smoothing_mm * rows / probe.scan_line_length_mm, smoothing_mm / across_mm)

    def resized(self, image: Tensor) -> Tensor:  # [H, W] -> [rows, columns]
        """A larger frame with the pixels of this scale: means of what they cover."""
        return functional.interpolate(image[None, None], size=(self.rows, self.columns), mode="area")[0, 0]

    def appearance(self, frames: Tensor) -> Tensor:  # [C, rows, columns] in [0, 1] -> [C, rows, columns]
        """The structures of frames, of strength 1 where there are any."""
        smooth = self._blurred(frames, 1.0)
        structure = smooth - self._blurred(smooth, NEIGHBOURHOOD)
        strength = self._blurred(structure.square(), NEIGHBOURHOOD)
        return structure / (strength + LEAST_STRENGTH**2).sqrt()

    def _blurred(self, frames: Tensor, times: float) -> Tensor:
        rows, columns = (
            _smoother(self.rows, times * self.sigma_rows),
            _smoother(self.columns, times * self.sigma_columns),
        )
        return rows @ frames @ columns.mT


@lru_cache(maxsize=32)
def _smoother(count: int, sigma: float) -> Tensor:  # [count, count]
    """The matrix that smooths so many values by a Gaussian; beyond the ends the outermost values go on."""
    if sigma < LEAST_SIGMA:
        return torch.eye(count)
    reach = max(1, math.ceil(REACH * sigma))
    offsets = torch.arange(-reach, reach + 1)
    weights = torch.exp(-0.5 * (offsets / sigma).square())
    places = (torch.arange(count)[:, None] + offsets).clamp(0, count - 1)
    return torch.zeros(count, count).scatter_add_(1, places, (weights / weights.sum()).expand(count, -1))
