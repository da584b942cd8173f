"""Learning from one training frame a step, all of them an epoch, with a field that a frame is a slice of."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
import torch
from torch import Tensor

from ultragray.datasets.sweep import Dataset
from ultragray.evaluation.compounding import pixel_positions_mm
from ultragray.methods.learner import Learner
from ultragray.methods.parts.similarity import Similarity
from ultragray.methods.parts.space import as_tensor
from ultragray.probe import FloatArray, Probe

SIMILARITY = Similarity(window=5, is_padded=True)  # of ImplicitVol's loss


def frame_of_step(step: int, frames: int, seed: int) -> int:
    """The training frame of step `step` (from 0): each of `frames` once an epoch, in an order that the epoch decides.

    The order follows from the number of the step alone, so that a fit that goes on after it was killed needs no state.
    """
    epoch, place = divmod(step, frames)
    return int(np.random.default_rng((seed, epoch)).permutation(frames)[place])


class SliceLearner(Learner):
    """A fit of a field whose value at a pixel's place is the pixel: it depends on no direction and on no other pixel.

    Coordinates of the field are those of the tracker, less `centre_mm`, over `half_mm`. The loss is 1 - SSIM of a whole
    frame. Frames are cut off at 0 and 1 where they are rendered, not where they are learned.
    """

    def __init__(
        self, dataset: Dataset, seed: int, device: torch.device, centre_mm: FloatArray, half_mm: FloatArray
    ) -> None:  # [3], [3]
        super().__init__(dataset, seed, device)
        self.seed, self.centre_mm, self.half_mm = seed, centre_mm, half_mm
        self.pixels_mm = self.pixels_of(dataset.probe, dataset.train.height, dataset.train.width)

    @abstractmethod
    def set_rates(self, step: int, steps: int) -> None:
        """Sets the optimisers' rates for step `step` (from 0) of `steps`."""

    @abstractmethod
    def values(self, points: Tensor) -> Tensor:  # [H, W, 3] -> [H, W]
        """The field at points in its own coordinates."""

    def training_points(self, place: int) -> Tensor:  # [H, W, 3]
        """The pixels of a training frame in the field's coordinates."""
        return self.in_field(self.pixels_mm, self.dataset.train.poses[place])

    def rendered_points(self, pixels_mm: Tensor, pose: FloatArray) -> Tensor:  # [H, W, 3] -> [H, W, 3]
        """The pixels of a frame that is asked for at a pose (mm, probe→tracker), in the field's coordinates."""
        return self.in_field(pixels_mm, pose)

    def pixels_of(self, probe: Probe, height: int, width: int) -> Tensor:  # [H, W, 3]
        """The place of each pixel in the probe frame, mm."""
        return as_tensor(pixel_positions_mm(probe, height, width).reshape(height, width, 3), self.device)

    def in_field(self, pixels_mm: Tensor, pose: FloatArray) -> Tensor:  # [H, W, 3] -> [H, W, 3]
        """Points of the probe frame, seen from a pose (mm, probe→tracker), in the field's coordinates."""
        rotation = as_tensor(pose[:3, :3] / self.half_mm[:, None], self.device)
        return pixels_mm @ rotation.T + as_tensor((pose[:3, 3] - self.centre_mm) / self.half_mm, self.device)

    def loss(self, step: int, steps: int) -> Tensor:
        self.set_rates(step, steps)
        place = frame_of_step(step, len(self.images), self.seed)
        found = self.values(self.training_points(place))
        return 1.0 - SIMILARITY.ssim(found[None], self.image(place)[None])

    def frame(self, probe: Probe, pose: FloatArray, height: int, width: int) -> Tensor:
        points = self.rendered_points(self.pixels_of(probe, height, width), pose)
        return self.values(points).clamp(0.0, 1.0)


def set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """The same rate for all parameters of an optimiser."""
    for group in optimizer.param_groups:
        group["lr"] = rate
