"""What a search compares: frames by their structures, after small motions of the probe."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional

from ultragray.geometry.probe import Probe
from ultragray.learn.sweep import pixel_positions_mm
from ultragray.learn.training.poses import turned_by

PixelArray: TypeAlias = npt.NDArray[np.float32]

# Small motions of the probe: shifts along its own axes and turns about the middle of its image, all in mm.
#
# A turn is given by the way that it moves a point at the typical distance from the middle, so that steps of all six
# numbers weigh alike.

GRID = 16  # rows and columns of the image that are looked at


@dataclass(frozen=True, eq=False)
class Motions:
    """Motions of one probe."""

    middle_mm: Tensor  # [3] of its image, in the probe frame, float64
    lever_mm: float  # typical distance of a pixel from there

    @classmethod
    def of(cls, probe: Probe) -> Motions:
        positions = torch.from_numpy(pixel_positions_mm(probe, GRID, GRID))
        middle = positions.mean(dim=0)
        return cls(middle, float((positions - middle).square().sum(dim=1).mean().sqrt()))

    def moved(self, poses: Tensor, steps: Tensor) -> Tensor:  # [..., 4, 4], [..., 6] mm -> [..., 4, 4]
        return poses @ self.of_steps(steps)

    def of_steps(self, steps: Tensor) -> Tensor:  # [..., 6] mm -> [..., 4, 4]
        """In the probe frame: three shifts and three turns, about lateral, elevation and axial axis."""
        shifts, turns = steps[..., :3], steps[..., 3:] / self.lever_mm
        rotations = turned_by(turns.reshape(-1, 3)).reshape(*turns.shape[:-1], 3, 3)
        motions = torch.zeros(*steps.shape[:-1], 4, 4, dtype=steps.dtype)
        motions[..., :3, :3] = rotations
        motions[..., :3, 3] = self.middle_mm - rotations @ self.middle_mm + shifts
        motions[..., 3, 3] = 1.0
        return motions

    def step_between(self, before: Tensor, after: Tensor) -> tuple[float, float]:  # [4, 4] both
        """How far the middle of the image moves, mm, and the image turns, degrees."""
        middle = torch.cat([self.middle_mm, torch.ones(1, dtype=torch.float64)])
        shift_mm = float(((after - before) @ middle).norm())
        cosine = (float((before[:3, :3].T @ after[:3, :3]).trace()) - 1.0) / 2.0
        return shift_mm, math.degrees(math.acos(max(-1.0, min(1.0, cosine))))

    def degrees(self, turns_mm: Tensor) -> Tensor:
        return torch.rad2deg(turns_mm / self.lever_mm)


_SMALL_MM = 1e-3


@lru_cache(maxsize=32)
def displacements(probe: Probe, rows: int, columns: int) -> Tensor:  # [6, 3, rows, columns]
    """What pixels of a frame come to show, per mm of each number of a motion: the tissue so many rows and columns
    further on, and so many mm out of the image plane.
    """
    pixels, across = pixel_positions_mm(probe, rows, columns), probe.lines
    steps = _SMALL_MM * torch.eye(6, dtype=torch.float64)
    moves = Motions.of(probe).of_steps(torch.cat([steps, -steps])).numpy()
    moved = pixels @ moves[:, :3, :3].transpose(0, 2, 1) + moves[:, None, :3, 3]  # [12, pixels, 3]
    depths_mm, lines = across.coordinates(moved[..., 0], moved[..., 2])
    row_mm, pitch = probe.scan_line_length_mm / rows, across.span / columns
    places = np.stack([depths_mm / row_mm, lines / pitch, moved[..., 1]], axis=1)
    changes = (places[:6] - places[6:]) / (2.0 * _SMALL_MM)
    return torch.from_numpy(changes.reshape(6, 3, rows, columns)).float()


# What of a frame is compared: its structures at some size, whatever gain and shadow made of their brightness.
#
# A frame is smoothed, its mean over a wider neighbourhood is taken off, and what is left is divided by its own
# strength there. Coarse structures match from far away, fine ones tell the place exactly.

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

    def appearance(self, frames: Tensor) -> PixelArray:  # [C, rows, columns] in [0, 1] -> [C, rows, columns]
        """The structures of frames, of strength 1 where there are any."""
        smooth = self._blurred(frames.numpy(), 1.0)
        structure = smooth - self._blurred(smooth, NEIGHBOURHOOD)
        strength = self._blurred(np.square(structure), NEIGHBOURHOOD)
        appearance: PixelArray = structure / np.sqrt(strength + np.float32(LEAST_STRENGTH**2))
        return appearance

    def _blurred(self, frames: PixelArray, times: float) -> PixelArray:
        """By OpenCV: on a busy machine torch's threads wait for each other many times as long as this takes."""
        along, across = (_weights(times * sigma) for sigma in (self.sigma_rows, self.sigma_columns))
        return np.stack([cv2.sepFilter2D(one, -1, across, along, borderType=cv2.BORDER_REPLICATE) for one in frames])


@lru_cache(maxsize=32)
def _weights(sigma: float) -> PixelArray:  # [2 reach + 1]
    """Of a Gaussian that smooths; beyond the ends of what is smoothed the outermost values go on."""
    if sigma < LEAST_SIGMA:
        return np.ones(1, np.float32)
    reach = max(1, math.ceil(REACH * sigma))
    weights = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) / sigma))
    return np.asarray(weights / weights.sum(), np.float32)
