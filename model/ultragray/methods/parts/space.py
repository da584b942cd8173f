"""The space that a sweep covers, and the places of pixels in it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ultragray.datasets.sweep import Sweep
from ultragray.evaluation.compounding import pixel_positions_mm
from ultragray.probe import FloatArray, Probe


@dataclass(frozen=True, eq=False)
class Box:
    """The box, along the tracker's axes, around the corners of all training frames."""

    centre_mm: FloatArray  # [3]
    half_mm: FloatArray  # [3]

    @classmethod
    def of(cls, sweep: Sweep) -> Box:
        corners = sweep.corners_mm().reshape(-1, 3)
        low, high = corners.min(axis=0), corners.max(axis=0)
        return cls((low + high) / 2.0, (high - low) / 2.0)

    @property
    def largest_half_mm(self) -> float:
        """By which a cube around the box is scaled to [-1, 1], so that no axis is stretched."""
        return float(self.half_mm.max())

    def normalised(self, points_mm: FloatArray) -> FloatArray:  # [..., 3] -> [..., 3]
        """Points in the cube of side 2 around the box."""
        found: FloatArray = (points_mm - self.centre_mm) / self.largest_half_mm
        return found


def pixel_points_mm(probe: Probe, pose: FloatArray, height: int, width: int) -> FloatArray:  # [H, W, 3]
    """The place of each pixel in the tracker's frame, mm, of a frame at a pose [4, 4]."""
    points = pixel_positions_mm(probe, height, width) @ pose[:3, :3].T + pose[:3, 3]
    found: FloatArray = points.reshape(height, width, 3)
    return found


def as_tensor(array: FloatArray, device: torch.device) -> Tensor:
    """float32 on the device."""
    return torch.from_numpy(array).to(device, torch.float32)
