"""The frames of a step, and their shift out of their planes."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ultragray.datasets.sweep import IntArray, Sweep, corner_distances_mm, spread_places
from ultragray.probe import FloatArray

TELLING_NEIGHBOURS = 8  # with fewer, PSNR only says that speckle averages out
MAX_SLICE_MM = 8.0  # no probe's slice is thicker
RANGES = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 11.0, 16.0, 23.0, 32.0)  # × the distance of neighbouring frames
PREDICTED_FRAMES, PREDICTED_PIXELS = 256, 4096  # enough to tell one range from another


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


def out_of_plane_range_mm(sweep: Sweep) -> float:
    """The blur of a slice along elevation that the frames themselves show, as the full range of the shift.

    Each frame is predicted by its neighbours within ± half a range, with the weights that the shift is drawn with.
    Half the range with the best mean PSNR is taken (PSNR likes blur; the half has most of the gain and keeps detail),
    at most MAX_SLICE_MM, if the median frame has eight others or more within ± half that range: among fewer the mean of
    all wins, however far apart they are. Else 0.
    """
    corners = sweep.corners_mm()  # [F, K, 3]
    distances = np.stack([corner_distances_mm(own, corners) for own in corners])  # [F, F]
    np.fill_diagonal(distances, np.inf)
    step_mm = float(np.median(distances.min(axis=1)))
    if step_mm == 0.0:
        return 0.0
    pixels = sweep.images.reshape(len(sweep), -1)
    stride = max(1, pixels.shape[1] // PREDICTED_PIXELS) | 1  # odd: it must not fall into step with the columns
    images = torch.from_numpy(pixels[:, ::stride].astype(np.float32)) / 255.0  # [F, P]
    targets = spread_places(len(sweep), PREDICTED_FRAMES)
    ranges_mm = [factor * step_mm for factor in RANGES]
    scores = [_psnr_from_neighbours(images, distances[targets], targets, range_mm) for range_mm in ranges_mm]
    best_mm = ranges_mm[int(np.argmax(scores))]
    neighbours = float(np.median((distances[targets] < best_mm / 2).sum(axis=1)))
    return min(0.5 * best_mm, MAX_SLICE_MM) if neighbours >= TELLING_NEIGHBOURS else 0.0


def _psnr_from_neighbours(images: Tensor, distances: FloatArray, targets: IntArray, range_mm: float) -> float:
    """Mean PSNR, dB, of frames `targets` [T] predicted by those within half a range; by the nearest where none is."""
    weights = np.where(distances < range_mm / 2, np.cos(np.pi * np.minimum(distances, range_mm) / range_mm) ** 2, 0.0)
    alone = weights.sum(axis=1) < 1e-6
    weights[alone, distances[alone].argmin(axis=1)] = 1.0
    shares = torch.from_numpy(weights / weights.sum(axis=1, keepdims=True)).float()
    errors = (shares @ images - images[torch.from_numpy(targets)]).square().mean(dim=1)
    return float((-10.0 * (errors + 1e-9).log10()).mean())


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
