"""Corrections of poses that are trained beside the scene, by the true gradients of its frames (docs/physics.md §4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from ultragray.datasets.sweep import Sweep
from ultragray.probe import FloatArray

START = 0.1  # share of the run: before, there is no anatomy to compare with
RATE = 0.01  # mm a step: at the end of a long run some tenths of a mm from where it began
WITHIN_THE_PLANE = (0.1, 1.0, 0.1, 1.0, 0.1, 1.0)  # a frame's own image hardly shows moves out of its plane
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
        self._twists = torch.zeros((len(groups), 6), dtype=torch.float64, requires_grad=True)
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

    def update(self, rate: float) -> None:
        """One update of every group by its own gradient, at `rate` mm."""
        self._adam.param_groups[0]["lr"] = rate
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def tensors(self) -> dict[str, Tensor]:
        """The state, for a checkpoint."""
        state = self._adam.state.get(self._twists, {})
        return {"twists": self._twists.detach(), **state}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Inverse of `tensors`."""
        with torch.no_grad():
            self._twists.copy_(tensors["twists"])
        state = {name: value for name, value in tensors.items() if name != "twists"}
        if state:
            self._adam.state[self._twists] = state

    def _motions(self, groups: Tensor) -> Tensor:  # [b] -> [b, 4, 4]
        twists, middles, axes = self._twists[groups] * self._ease, self._middles[groups], self._axes[groups]
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
        self._roughness().backward()  # type: ignore[no-untyped-call]
        self.update(_rate(done))
        with torch.no_grad():
            self._remove_common_motion()

    def _roughness(self) -> Tensor:
        bends = [torch.diff(self._twists[sweep.start : sweep.stop], 2, dim=0).square().sum() for sweep in self._ranges]
        return SMOOTHNESS * torch.stack(bends).sum()

    def _remove_common_motion(self) -> None:
        """Takes the mean of all turns and shifts, in the tracker's axes, off each."""
        parts = self._twists.reshape(-1, 2, 3)
        common = torch.einsum("gij,gpj->pi", self._axes, parts) / len(parts)
        parts -= torch.einsum("gij,pi->gpj", self._axes, common)


class SweepCorrections(Corrections):
    """A correction for each sweep as a whole; that of the first is the identity."""

    def __init__(self, sweep: Sweep, ranges: Sequence[range]) -> None:
        super().__init__(sweep, ranges)

    def step(self, done: float) -> None:
        """One update by the gradient of a step, `done` being the share of the run that is done."""
        self.update(_rate(done))
        with torch.no_grad():
            self._twists[0] = 0.0


def _rate(done: float) -> float:  # mm a step
    return RATE * (0.0 if done < START else 1.0 - done)


def turned_by(turns: Tensor) -> Tensor:  # [G, 3] rad -> [G, 3, 3]
    """The rotations of turns, each an axis times an angle; differentiable, also at 0."""
    x, y, z = turns.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(-1, 3, 3)
    rotations: Tensor = torch.linalg.matrix_exp(cross)
    return rotations
