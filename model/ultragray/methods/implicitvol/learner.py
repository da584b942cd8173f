"""The fits of ImplicitVol: of the field alone, and of the field together with the poses of the training frames."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from ultragray.datasets.sweep import Dataset
from ultragray.methods.implicitvol.field import SineField
from ultragray.methods.implicitvol.poses import FramePoses
from ultragray.methods.parts.slices import SliceLearner, set_rate
from ultragray.probe import FloatArray

EPOCHS = 10_001  # of the paper
RATE = 1e-3  # of the network and of the poses
NETWORK_DECAY, NETWORK_DECAY_EPOCHS = 0.9954, 10
POSE_DECAY, POSE_DECAY_EPOCHS = 0.9, 100
RESTART_EPOCHS, RESTARTS = 500, 9  # the last before epoch 5,000


def published_epoch(step: int, steps: int) -> int:
    """The epoch of the paper's 10,001 that step `step` (from 0) of `steps` stands for: schedules are stretched."""
    return EPOCHS * step // steps


class FieldLearner(SliceLearner):
    """A fit with the tracker's poses."""

    def __init__(self, dataset: Dataset, seed: int, device: torch.device) -> None:
        self.half_height_mm = dataset.probe.scan_line_length_mm / 2.0
        super().__init__(dataset, seed, device, dataset.centre_mm, np.full(3, self.half_height_mm))
        self.field = SineField(self.generator).to(device)
        self.module = nn.ModuleDict({"field": self.field})
        self.optimizers = {"field": torch.optim.Adam(self.field.parameters(), RATE)}

    def set_rates(self, step: int, steps: int) -> None:
        decays = published_epoch(step, steps) // NETWORK_DECAY_EPOCHS
        set_rate(self.optimizers["field"], RATE * NETWORK_DECAY**decays)

    def values(self, points: Tensor) -> Tensor:
        found: Tensor = self.field(points)
        return found


class RefiningLearner(FieldLearner):
    """A fit that moves the training frames too.

    In the first half the network is thrown away at regular steps, and what both optimisers remember with it, while the
    poses are kept: else the network would learn the misplaced frames by heart before these have moved.
    """

    def __init__(self, dataset: Dataset, seed: int, device: torch.device) -> None:
        super().__init__(dataset, seed, device)
        self.poses = FramePoses(dataset.train, self.centre_mm, self.half_height_mm, device)
        self.module = nn.ModuleDict({"field": self.field, "poses": self.poses})
        self.optimizers = {**self.optimizers, "poses": torch.optim.Adam(self.poses.parameters(), RATE)}

    def set_rates(self, step: int, steps: int) -> None:
        super().set_rates(step, steps)
        decays = published_epoch(step, steps) // POSE_DECAY_EPOCHS
        set_rate(self.optimizers["poses"], RATE * POSE_DECAY**decays)

    def training_points(self, place: int) -> Tensor:
        return self.poses.points(place, self.pixels_mm)

    def rendered_points(self, pixels_mm: Tensor, pose: FloatArray) -> Tensor:
        rotation, translation = self.poses.common_motion()
        return self.in_field(pixels_mm, pose) @ rotation.T + translation

    def after_step(self, step: int, steps: int) -> None:
        if _restarts_before(step + 1, steps) > _restarts_before(step, steps):
            self.field.draw(self.generator)
            for optimizer in self.optimizers.values():
                optimizer.state.clear()


def _restarts_before(step: int, steps: int) -> int:
    """The restarts that are due before step `step` (from 0)."""
    return min(published_epoch(step, steps) // RESTART_EPOCHS, RESTARTS)
