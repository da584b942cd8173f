"""Pose refinement of a training run: before it by the path and the images, and in it together with the scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from torch import Tensor

from ultragray.backends.poses import ScenePoses
from ultragray.datasets.sweep import Dataset
from ultragray.probe import FloatArray
from ultragray.training.poses.overlap import register_sweeps
from ultragray.training.poses.path import sweep_ranges, tracker_noise, without_noise
from ultragray.training.poses.trained import FrameCorrections, SweepCorrections

_TRAINED: dict[str, type[FrameCorrections | SweepCorrections]] = {
    "frames": FrameCorrections,
    "sweeps": SweepCorrections,
}


class PoseRefinement:
    """The corrections of the training frames, left-multiplied to their poses; `dataset` is the one to train from."""

    def __init__(
        self, dataset: Dataset, tracked: FloatArray, trained: FrameCorrections | SweepCorrections | None
    ) -> None:
        """`dataset` has the poses that the training begins with, `tracked` [F, 4, 4] (mm) are those of its frames."""
        self.dataset, self._tracked, self._trained = dataset, tracked, trained

    @classmethod
    def of(cls, dataset: Dataset, mode: str) -> PoseRefinement:
        """Estimates the poses that the training begins with.

        `frames`: the tracker's noise is taken out of each sweep, each sweep is registered as a whole to those that it
        crosses, and in the training every frame has a correction of its own. `sweeps`: only whole sweeps move. With
        `none`, and where the poses are good (little noise, sweeps agree), they stay and none is trained.
        """
        tracked = dataset.train.poses
        if mode == "none":
            return cls(dataset, tracked, None)
        ranges = sweep_ranges(dataset.train)
        poses = tracked.copy()
        if mode == "frames" and not tracker_noise(poses, ranges).is_small:
            poses = without_noise(poses, ranges)
        for frames, motion in zip(ranges, register_sweeps(replace(dataset.train, poses=poses), ranges), strict=True):
            poses[frames] = motion @ poses[frames]
        if np.array_equal(poses, tracked):
            return cls(dataset, tracked, None)
        train = replace(dataset.train, poses=poses)
        return cls(replace(dataset, train=train), tracked, _TRAINED[mode](train, ranges))

    @property
    def group_count(self) -> int:
        """The number of corrections that are trained: 0 where none is."""
        return 0 if self._trained is None else self._trained.group_count

    def corrected(self, places: Tensor, poses: FloatArray) -> ScenePoses:  # [b], [b, 4, 4] mm -> [b, 4, 4] mm
        """Poses of a batch as they are by now, with the graph of their corrections where these are trained."""
        return poses if self._trained is None else self._trained.corrected(places, poses)

    def step(self, done: float) -> None:
        """One update after a step's backward pass, `done` being the share of the run that is done."""
        if self._trained is not None:
            self._trained.step(done)

    def poses(self) -> FloatArray:  # [F, 4, 4] mm
        """The corrected poses of all training frames, as they are by now."""
        poses = self.dataset.train.poses
        return poses if self._trained is None else self._trained.all_motions() @ poses

    def corrections(self) -> FloatArray | None:  # [F, 4, 4]
        """The motions that are left-multiplied to the tracker's poses; None where these stay."""
        return None if self._trained is None else self.poses() @ np.linalg.inv(self._tracked)

    def tensors(self) -> dict[str, Tensor]:
        """The state of the trained corrections, for a checkpoint."""
        return {} if self._trained is None else self._trained.tensors()

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Inverse of `tensors`."""
        if self._trained is not None:
            self._trained.load(tensors)
