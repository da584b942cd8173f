"""Which frames a step sees, and from how far out of their planes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..probe import FloatArray


class BatchSampler:
    """Goes through the frames in a new random order again and again, a batch at a time."""

    def __init__(self, frame_count: int, batch_size: int, generator: torch.Generator) -> None:
        self.batch_size = min(batch_size, frame_count)
        self.generator = generator
        self.waiting = torch.zeros(0, dtype=torch.int64)  # frames of this round that were not seen yet
        self._frame_count = frame_count

    def next_batch(self) -> Tensor:  # [b]
        """The places of the next frames."""
        while len(self.waiting) < self.batch_size:
            order = torch.randperm(self._frame_count, generator=self.generator)
            self.waiting = torch.cat([self.waiting, order])
        batch, self.waiting = self.waiting[: self.batch_size], self.waiting[self.batch_size :]
        return batch


def out_of_plane_shift_mm(range_mm: float, generator: torch.Generator) -> float:
    """x·range with x in [−½, ½], drawn uniformly and accepted with probability cos²(πx)."""
    while True:
        x, threshold = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
        if threshold <= math.cos(math.pi * (x - 0.5)) ** 2:
            return float((x - 0.5) * range_mm)


def shift_out_of_plane(poses: FloatArray, shift_mm: float) -> FloatArray:  # [C, 4, 4] mm -> [C, 4, 4] mm
    """The poses, each moved along its own elevation axis."""
    shifted = poses.copy()
    shifted[:, :3, 3] += shift_mm * poses[:, :3, 1]
    return shifted
