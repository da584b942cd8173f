"""Corrections of poses that are trained beside the scene, by the true gradients of its frames (docs/physics.md §4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from ...datasets.sweep import Sweep
from ...probe import FloatArray
from .motion import motions_of

START = 0.1  # share of the run: before, there is no anatomy to compare with
RATE = 0.01  # mm a step: at the end of a long run some tenths of a mm from where it began
WITHIN_THE_PLANE = (0.1, 1.0, 0.1, 1.0, 0.1, 1.0)  # a frame's own image says little of moves out of its plane
SMOOTHNESS = 1e-3  # weight of the squared second differences of neighbouring corrections, mm²


class TrainedCorrections:
    """One rigid motion for each group of frames, left-multiplied to their poses: a turn about their middle and a shift.

    Both are along the axes of the probe, times `ease` [6]. Turns are held as what they move the image
    by: radians times the mean distance of its corners from its middle, mm. Frames one by one keep a mean motion of
    nothing, and neighbours bend little; of whole sweeps the first stays.
    """

    def __init__(
        self, sweep: Sweep, groups: Sequence[range], *, whole_sweeps: bool, ease: Sequence[float] = (1.0,) * 6
    ) -> None:
        corners = sweep.corners_mm()  # [F, K, 3]
        self._whole, self._ranges = whole_sweeps, list(groups)
        frames = [list(group) for group in groups] if whole_sweeps else [[place] for place in range(len(sweep))]
        self._group_of = torch.zeros(len(sweep), dtype=torch.int64)
        for number, places in enumerate(frames):
            self._group_of[places] = number
        middles = corners.mean(axis=1)
        middle_frames = [places[len(places) // 2] for places in frames]
        self._axes = torch.from_numpy(sweep.poses[middle_frames, :3, :3])  # [G, 3, 3]
        self._ease = torch.tensor(ease, dtype=torch.float64)
        self._middles = torch.from_numpy(np.stack([middles[places].mean(axis=0) for places in frames]))  # [G, 3]
        self._lever_mm = float(np.linalg.norm(corners - middles[:, None], axis=-1).mean())
        self._twists = torch.zeros((len(frames), 6), dtype=torch.float64, requires_grad=True)
        self._adam = torch.optim.Adam([self._twists], lr=0.0, betas=(0.9, 0.99), eps=1e-12)

    @property
    def group_count(self) -> int:
        return len(self._twists)

    def corrected(self, places: Tensor, poses: FloatArray) -> Tensor:  # [b], [b, 4, 4] -> [b, 4, 4] mm
        """Poses of the frames at these places, moved by their corrections, with their graph."""
        return self._motions(self._group_of[places]) @ torch.from_numpy(poses)

    def all_motions(self) -> FloatArray:  # [F, 4, 4]
        """The correction of every frame."""
        with torch.no_grad():
            found: FloatArray = self._motions(self._group_of).numpy()
        return found

    def step(self, done: float) -> None:
        """One update by the gradient of a step, `done` being the share of the run that is done."""
        if not self._whole:
            self._roughness().backward()  # type: ignore[no-untyped-call]
        self.update(RATE * (0.0 if done < START else 1.0 - done))
        with torch.no_grad():
            if self._whole:
                self._twists[0] = 0.0
            else:
                self._remove_common_motion()

    def _remove_common_motion(self) -> None:
        """Takes the mean of all turns and shifts, in the tracker's axes, off each."""
        parts = self._twists.reshape(-1, 2, 3)
        common = torch.einsum("gij,gpj->pi", self._axes, parts) / len(parts)
        parts -= torch.einsum("gij,pi->gpj", self._axes, common)

    def update(self, rate: float) -> None:
        """One update of every group by its own gradient, whatever its neighbours do."""
        self._adam.param_groups[0]["lr"] = rate
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def tensors(self) -> dict[str, Tensor]:
        """What a checkpoint keeps."""
        state = self._adam.state.get(self._twists, {})
        return {"twists": self._twists.detach(), **state}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Inverse of `tensors`."""
        with torch.no_grad():
            self._twists.copy_(tensors["twists"])
        state = {name: value for name, value in tensors.items() if name != "twists"}
        if state:
            self._adam.state[self._twists] = state

    def _roughness(self) -> Tensor:
        bends = [torch.diff(self._twists[group.start : group.stop], 2, dim=0).square().sum() for group in self._ranges]
        return SMOOTHNESS * torch.stack(bends).sum()

    def _motions(self, groups: Tensor) -> Tensor:  # [b] -> [b, 4, 4]
        twists, middles, axes = self._twists[groups] * self._ease, self._middles[groups], self._axes[groups]
        turns = torch.einsum("gij,gj->gi", axes, twists[:, :3]) / self._lever_mm
        motions = motions_of(torch.cat([turns, torch.zeros_like(middles)], dim=1))
        shifts = middles - torch.einsum("gij,gj->gi", motions[:, :3, :3], middles)
        shifts = shifts + torch.einsum("gij,gj->gi", axes, twists[:, 3:])
        moved = torch.zeros_like(motions)
        moved[:, :3, 3] = shifts
        return motions + moved
