"""The stages of pose refinement: before the training by path and images, then beside the scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from torch import Tensor

from ...backends.poses import ScenePoses
from ...datasets.sweep import Dataset
from ...probe import FloatArray
from .overlap import register_sweeps
from .path import sweep_ranges, tracker_noise, without_noise
from .trained import WITHIN_THE_PLANE, TrainedCorrections


class PoseRefinement:
    """The corrections of the training frames, left-multiplied to their poses; `dataset` is the one to train from.

    `frames`: each sweep is freed from its tracker's noise, then registered as a whole to those that it crosses, then
    every frame has a correction of its own in the training. `sweeps`: only whole sweeps move. Good poses, whose noise
    is small and whose sweeps agree, are left alone, as with `none`: then nothing is trained.
    """

    def __init__(self, dataset: Dataset, mode: str) -> None:
        self.dataset = dataset
        self._given = dataset.train.poses
        self._trained: TrainedCorrections | None = None
        if mode == "none":
            return
        ranges = sweep_ranges(dataset.train)
        poses = self._given.copy()
        if mode == "frames" and not tracker_noise(poses, ranges).is_small:
            poses = without_noise(poses, ranges)
        for frames, motion in zip(ranges, register_sweeps(replace(dataset.train, poses=poses), ranges), strict=True):
            poses[frames] = motion @ poses[frames]
        if not np.array_equal(poses, self._given):
            self.dataset = replace(dataset, train=replace(dataset.train, poses=poses))
            whole = {"sweeps": True, "frames": False}[mode]
            ease = {} if whole else {"ease": WITHIN_THE_PLANE}
            self._trained = TrainedCorrections(self.dataset.train, ranges, whole_sweeps=whole, **ease)

    @property
    def group_count(self) -> int:
        """Corrections that are trained: 0 where nothing is."""
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
        """What is left-multiplied to the given poses; None where they stay."""
        return None if self._trained is None else self.poses() @ np.linalg.inv(self._given)

    def tensors(self) -> dict[str, Tensor]:
        """What a checkpoint keeps."""
        return {} if self._trained is None else self._trained.tensors()

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Inverse of `tensors`."""
        if self._trained is not None:
            self._trained.load(tensors)
