"""Small motions of the probe: shifts along its own axes and turns about the middle of its image, all in mm.

A turn is given by the way that it moves a point at the typical distance from the middle, so that steps of all six
numbers weigh alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ultragray.evaluation.compounding import pixel_positions_mm
from ultragray.probe import Probe
from ultragray.training.poses.trained import turned_by

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
        """Poses after steps."""
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
        """Turns given in mm."""
        return torch.rad2deg(turns_mm / self.lever_mm)
