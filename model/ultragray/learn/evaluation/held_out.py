"""Scores of held-out frames whose own poses may be wrong, three ways side by side.

- As given: at the poses of the data set.
- On the path: at the poses of the path that the scene was trained on, which no held-out image has a part in.
- Registered: a frame whose pose is off by a millimetre scores badly even in a perfect scene, and one that was
  registered as a whole scores too well. So it is registered by its left half alone, which gives its right half, and the
  other way round; the two halves together are what is scored.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ultragray.errors import DatasetInvalid
from ultragray.learn.evaluation.scoring import Evaluation, evaluate, evaluate_frames, frames_at_once, require_frames
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.training.losses import SSIM_WINDOW, image_loss
from ultragray.learn.training.poses import Corrections, held_out_on_path
from ultragray.rendering.frames import render
from ultragray.scene.gaussians import GaussianScene

STEPS = 60
TEXTURE = 0.5  # share of SSIM in the loss that a frame is moved by
RATE = 0.1  # mm a step, falling to 0


@dataclass(frozen=True, eq=False)
class Registered:
    """The scores of frames that were registered by halves, and by how much that moved their middles (mean, mm)."""

    evaluation: Evaluation
    moved_mm: float


@dataclass(frozen=True, eq=False)
class HeldOutScores:
    """The scores of held-out frames by three kinds of poses."""

    as_given: Evaluation
    on_path: Evaluation | None = None  # None: the path is that of the data set, or belongs to another one
    registered: Registered | None = None  # None: it was not asked for

    @property
    def rows(self) -> dict[str, Evaluation]:
        """Those that there are, by what tables call them."""
        evaluations = {"as given": self.as_given, "on the path": self.on_path}
        if self.registered is not None:
            evaluations[f"registered by halves ({self.registered.moved_mm:.2f} mm)"] = self.registered.evaluation
        return {name: evaluation for name, evaluation in evaluations.items() if evaluation is not None}

    def to_dict(self) -> dict[str, Any]:
        """A JSON object of three: mean and standard deviation of each metric, null where there are none."""
        evaluations = {"as_given": self.as_given, "on_path": self.on_path}
        document: dict[str, Any] = {name: one and _means(one) for name, one in evaluations.items()}
        registered = self.registered
        document["registered"] = registered and {**_means(registered.evaluation), "moved_mm": registered.moved_mm}
        return document

    def figures(self) -> dict[str, float]:
        """The means on the path and registered, as figures of a job."""
        registered = None if self.registered is None else self.registered.evaluation
        evaluations = {"on_path": self.on_path, "registered": registered}
        return {
            f"{name}_{metric}": value
            for name, evaluation in evaluations.items()
            if evaluation is not None
            for metric, value in evaluation.mean.to_dict().items()
        }


def _means(evaluation: Evaluation) -> dict[str, Any]:
    return {"mean": evaluation.mean.to_dict(), "std": evaluation.std.to_dict()}


def score_held_out(
    scene: GaussianScene, dataset: Dataset, as_given: Evaluation, *, register: bool = False, backend: str = "auto"
) -> HeldOutScores:
    """The scores beside those of `dataset.val` as given; `register`: also registered by halves, which takes minutes.

    Raises as `evaluate` and `register_halves` do.
    """
    placed = held_out_on_path(dataset, scene)
    at_rest = scene.at_rest()
    on_path = None if placed is None else evaluate(at_rest, placed, backend=backend)
    start = replace(dataset.val, poses=scene.poses_at_rest(dataset.val.poses)) if placed is None else placed
    return HeldOutScores(as_given, on_path, register_halves(at_rest, start, backend=backend) if register else None)


def register_halves(scene: GaussianScene, sweep: Sweep, *, backend: str = "auto") -> Registered:
    """Of all frames of a sweep. Raises DatasetInvalid where there are none, or halves are too narrow to compare."""
    require_frames(sweep)
    middle = sweep.width // 2
    if min(middle, sweep.height) < SSIM_WINDOW:
        raise DatasetInvalid(
            f"{sweep.source}: to be registered by halves, frames must have at least {SSIM_WINDOW} rows and "
            f"{2 * SSIM_WINDOW} columns, got {sweep.height}x{sweep.width}"
        )
    halves = (slice(0, middle), slice(middle, sweep.width))
    frames, moved_mm = np.empty(sweep.images.shape, np.float32), []
    centre = torch.from_numpy(np.append(sweep.probe.corners_mm().mean(axis=0), 1.0))
    count = frames_at_once(sweep.height, sweep.width)
    for first in range(0, len(sweep), count):
        places = np.arange(first, min(first + count, len(sweep)))
        some = sweep.select(places)
        truth = torch.from_numpy(some.images).to(scene.means.device).float() / 255.0
        for fitted, scored in (halves, halves[::-1]):
            poses = _fitted(scene, some, truth, fitted, backend)
            frames[places, :, scored] = _rendered(scene, some, poses, backend).detach().cpu().numpy()[..., scored]
            moved_mm.append(((poses - torch.from_numpy(some.poses)) @ centre).norm(dim=1))
    return Registered(evaluate_frames(frames, sweep), float(torch.cat(moved_mm).mean()))


def _fitted(scene: GaussianScene, sweep: Sweep, truth: Tensor, columns: slice, backend: str) -> Tensor:  # [F, 4, 4]
    corrections = Corrections(sweep, [[place] for place in range(len(sweep))])
    places = torch.arange(len(sweep))
    target = truth[..., columns].contiguous()
    for step in range(STEPS):
        frames = _rendered(scene, sweep, corrections.corrected(places, sweep.poses), backend)
        (len(sweep) * image_loss(frames[..., columns].contiguous(), target, TEXTURE)).backward()  # type: ignore[no-untyped-call]
        corrections.update(RATE * (1.0 - step / STEPS))
    return corrections.corrected(places, sweep.poses).detach()


def _rendered(scene: GaussianScene, sweep: Sweep, poses: Tensor, backend: str) -> Tensor:  # [F, H, W]
    height, width = sweep.height, sweep.width
    return render(scene, sweep.probe, poses, height=height, width=width, outputs=("bmode",), backend=backend)["bmode"]
