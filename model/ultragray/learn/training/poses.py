"""Poses that are trained with the scene.

`PoseRefinement` begins with what `agreement` and `alignment` find. Then each group of frames, one frame or a whole
sweep, has a twist ξ = (ω, t) in mm along the axes of its probe, and its poses are corrected by the motion
exp(ω̂ / lever) about the middle of its images, then the shift t. The gradient of the loss with respect to ξ is that of
the renderer (docs/physics.md §4). A common motion of all frames changes no image, so the mean of the corrections, or
that of the first sweep, is taken to be none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ultragray.geometry.probe import FloatArray
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.training.agreement import AgreedPath, Shares, agreed_path
from ultragray.learn.training.alignment import register_sweeps, sweep_ranges
from ultragray.rendering.backends.inputs import ScenePoses
from ultragray.scene.gaussians import GaussianScene

START = 0.1  # share of the run: before, there is no anatomy to compare with
RATE = 0.01  # mm a step: at the end of a long run some tenths of a mm from where it began
WITHIN_THE_PLANE = (0.1, 1.0, 0.1, 1.0, 0.1, 1.0)  # a frame's own image hardly shows moves out of its plane
WITH_PATH = ("path", "frames")  # refinements that begin with the path that frames agree with
SAME_PATH = 1e-4  # mm, and of the entries of a rotation: arithmetic differs by less from machine to machine
SMOOTHNESS = 1e-3  # weight of the squared second differences of neighbouring corrections, mm²


class Corrections:
    """One rigid motion for each group of frames, left-multiplied to their poses: a turn about their middle and a shift.

    `groups` holds the places of the frames of each group. A motion is trained as a twist, three numbers of its turn and
    three of its shift along the axes of the probe, all in mm: of the turn, radians times the mean distance of the
    image's corners from its middle, which is how far it moves them. `ease` [6] scales the numbers, and with them how
    fast each is trained.
    """

    def __init__(self, sweep: Sweep, groups: Sequence[Sequence[int]], ease: Sequence[float] = (1.0,) * 6) -> None:
        corners = sweep.corners_mm()  # [F, K, 3]
        self._group_of = torch.zeros(len(sweep), dtype=torch.int64)
        for number, places in enumerate(groups):
            self._group_of[list(places)] = number
        middles = corners.mean(axis=1)
        middle_frames = [places[len(places) // 2] for places in groups]
        self._axes = torch.from_numpy(sweep.poses[middle_frames, :3, :3])  # [G, 3, 3]
        self._ease = torch.tensor(ease, dtype=torch.float64)
        self._middles = torch.from_numpy(np.stack([middles[list(places)].mean(axis=0) for places in groups]))  # [G, 3]
        self._lever_mm = float(np.linalg.norm(corners - middles[:, None], axis=-1).mean())
        self.twists = torch.zeros((len(groups), 6), dtype=torch.float64, requires_grad=True)
        self._adam = torch.optim.Adam([self.twists], lr=0.0, betas=(0.9, 0.99), eps=1e-12)

    def corrected(self, places: Tensor, poses: FloatArray) -> Tensor:  # [b], [b, 4, 4] -> [b, 4, 4] mm
        """Poses of the frames at these places, moved by their corrections, with their graph."""
        return self._motions(self._group_of[places]) @ torch.from_numpy(poses)

    def all_motions(self) -> FloatArray:  # [F, 4, 4]
        with torch.no_grad():
            return self._motions(self._group_of).numpy()

    def update(self, rate: float) -> None:
        """One update of every group by its own gradient, at `rate` mm."""
        self._adam.param_groups[0]["lr"] = rate
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def tensors(self) -> dict[str, Tensor]:
        state = self._adam.state.get(self.twists, {})
        return {"twists": self.twists.detach(), **state}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        with torch.no_grad():
            self.twists.copy_(tensors["twists"])
        state = {name: value for name, value in tensors.items() if name != "twists"}
        if state:
            self._adam.state[self.twists] = state

    def _motions(self, groups: Tensor) -> Tensor:  # [b] -> [b, 4, 4]
        twists, middles, axes = self.twists[groups] * self._ease, self._middles[groups], self._axes[groups]
        rotations = turned_by(torch.einsum("gij,gj->gi", axes, twists[:, :3]) / self._lever_mm)
        shifts = middles - torch.einsum("gij,gj->gi", rotations, middles)
        shifts = shifts + torch.einsum("gij,gj->gi", axes, twists[:, 3:])
        upper = torch.cat([rotations, shifts[..., None]], dim=-1)
        last = upper.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(upper), 1, 4)
        return torch.cat([upper, last], dim=1)


class FrameCorrections(Corrections):
    """A correction for each frame. Their mean is the identity, and those of neighbours are alike."""

    def __init__(self, sweep: Sweep, ranges: Sequence[range]) -> None:
        super().__init__(sweep, [[place] for place in range(len(sweep))], WITHIN_THE_PLANE)
        self._ranges = ranges

    def step(self, done: float) -> None:
        """One update by the gradient of a step, `done` being the share of the run that is done."""
        bends = [torch.diff(self.twists[sweep.start : sweep.stop], 2, dim=0).square().sum() for sweep in self._ranges]
        (SMOOTHNESS * torch.stack(bends).sum()).backward()  # type: ignore[no-untyped-call]
        self.update(_rate(done))
        with torch.no_grad():  # the mean of all turns and shifts, in the tracker's axes, is taken off each
            parts = self.twists.reshape(-1, 2, 3)
            common = torch.einsum("gij,gpj->pi", self._axes, parts) / len(parts)
            parts -= torch.einsum("gij,pi->gpj", self._axes, common)


class SweepCorrections(Corrections):
    """A correction for each sweep as a whole; that of the first is the identity."""

    def step(self, done: float) -> None:
        """One update by the gradient of a step, `done` being the share of the run that is done."""
        self.update(_rate(done))
        with torch.no_grad():
            self.twists[0] = 0.0


def _rate(done: float) -> float:  # mm a step
    return RATE * (0.0 if done < START else 1.0 - done)


def turned_by(turns: Tensor) -> Tensor:  # [G, 3] rad -> [G, 3, 3]
    """The rotations of turns, each an axis times an angle; differentiable, also at 0."""
    x, y, z = turns.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(-1, 3, 3)
    rotations: Tensor = torch.linalg.matrix_exp(cross)
    return rotations


TrainedCorrections: TypeAlias = FrameCorrections | SweepCorrections
_TRAINED: dict[str, type[TrainedCorrections]] = {"frames": FrameCorrections, "sweeps": SweepCorrections}


class PoseRefinement:
    """The poses of the training frames, as tracked and in the tissue at rest; `dataset`, the one to train from, has
    those at rest that the training begins with."""

    def __init__(self, dataset: Dataset, tracker_poses: FloatArray) -> None:  # [F, 4, 4] mm, by the tracker
        self.dataset, self._tracker_poses = dataset, tracker_poses
        self._trained: TrainedCorrections | None = None
        self._path: AgreedPath | None = None  # where poses at rest are others than as tracked

    @classmethod
    def of(cls, dataset: Dataset, mode: str) -> PoseRefinement:
        """Estimates the poses that the training begins with, and those of the held-out frames.

        `path`: frames lie on the path that their neighbours agree with. `sweeps`: each sweep is registered as a whole
        to those that it crosses, and in the training it has a correction. `frames`: both, and in the training every
        frame has a correction of its own. With `none`, and where the poses are good (neighbours and sweeps agree), they
        stay and none is trained.
        """
        refinement = cls(dataset, dataset.train.poses)
        if mode in WITH_PATH and (path := agreed_path(dataset)) is not None:
            refinement.dataset = path.of(dataset)
            refinement._path = None if np.array_equal(path.train, path.tracked) else path
        if mode in ("none", "path"):
            return refinement
        train = refinement.dataset.train
        ranges = sweep_ranges(train)
        poses = train.poses.copy()
        for frames, motion in zip(ranges, register_sweeps(train, ranges), strict=True):
            poses[frames] = motion @ poses[frames]
        if not np.array_equal(poses, refinement._tracker_poses):
            refinement.dataset = replace(refinement.dataset, train=replace(train, poses=poses))
            refinement._trained = _TRAINED[mode](refinement.dataset.train, ranges)
        return refinement

    @property
    def group_count(self) -> int:
        return 0 if self._trained is None else len(self._trained.twists)

    def corrected(self, places: Tensor, poses: FloatArray) -> ScenePoses:  # [b], [b, 4, 4] mm -> [b, 4, 4] mm
        """Poses of a batch as they are by now, with the graph of their corrections where these are trained."""
        return poses if self._trained is None else self._trained.corrected(places, poses)

    def step(self, done: float) -> None:
        """One update after a step's backward pass, `done` being the share of the run that is done."""
        if self._trained is not None:
            self._trained.step(done)

    def of_scene(self) -> dict[str, Any]:
        """What a scene keeps of the poses, as they are by now: arguments of `GaussianScene.from_splats`."""
        at_rest = self.dataset.train.poses
        if self._trained is not None:
            at_rest = self._trained.all_motions() @ at_rest
        poses = at_rest if self._path is None else self._path.tracked
        is_unchanged = np.array_equal(poses, self._tracker_poses)
        return {
            "training_poses": poses,
            "pose_corrections": None if is_unchanged else poses @ np.linalg.inv(self._tracker_poses),
            "rest_poses": None if self._path is None else at_rest,
        }

    @property
    def tissue_shares(self) -> Shares | None:
        return None if self._path is None else self._path.shares

    def tensors(self) -> dict[str, Tensor]:
        return {} if self._trained is None else self._trained.tensors()

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        if self._trained is not None:
            self._trained.load(tensors)


def held_out_on_path(dataset: Dataset, scene: GaussianScene) -> Sweep | None:
    """The held-out frames of the dataset that a scene was trained from, with the poses of the path it was trained on.

    None where these are the poses of the dataset, where the scene is of another one or was trained on another path
    (by an earlier version), or where nothing is held out.
    """
    mode = scene.info.training.get("refine_poses")
    if scene.info.dataset_sha256 != dataset.sha256 or mode not in WITH_PATH:
        return None
    if not len(dataset.val) or (path := agreed_path(dataset)) is None or path.of(dataset) is dataset:
        return None
    if mode == "path" and not np.allclose(scene.at_rest().training_poses, path.train, atol=SAME_PATH):
        return None
    return path.of(dataset).val
