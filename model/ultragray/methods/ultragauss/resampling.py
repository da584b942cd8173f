"""Densify and resample, as in 3D Gaussian Splatting: useless Gaussians go, others are split or duplicated instead."""

from __future__ import annotations

import torch
from torch import Tensor

from ultragray.training.config import TrainingConfig
from ultragray.training.steps.refinement import refine

INTERVAL = 100  # steps
FIRST, LAST = 500 / 30_000, 15_000 / 30_000  # as shares of the steps
LEAST_WEIGHT = 0.005
# Of 3D Gaussian Splatting: above 0.01 × the scene's scale a Gaussian is split, else duplicated. Sizes are not pruned.
_RECIPE = TrainingConfig.preset("fast", growth="even", split_scale=0.01, prune_above=100.0, prune_below=0.0)
MOMENTS = ("exp_avg", "exp_avg_sq")


def is_due(done: int, steps: int) -> bool:
    """Whether Gaussians are resampled after `done` of so many steps."""
    return done % INTERVAL == 0 and FIRST * steps <= done <= LAST * steps


def resample(
    gaussians: dict[str, Tensor],
    pull: Tensor,  # [N] mean ‖∂L/∂mean‖
    *,
    limit: int,
    scene_scale_cm: float,
    generator: torch.Generator,
) -> tuple[dict[str, Tensor], Tensor]:
    """New Gaussians, `limit` at most, and the row of each before, −1 for a new one.

    Weights under 0.005 go; then those that are pulled most are split or duplicated, as many as there is room for.
    """
    (kept,) = torch.nonzero(gaussians["transmittances"].sigmoid() >= LEAST_WEIGHT, as_tuple=True)
    refined = refine(
        {name: tensor[kept] for name, tensor in gaussians.items()},
        pull[kept],
        limit=limit,
        scene_scale_cm=scene_scale_cm,
        config=_RECIPE,
        generator=generator,
    )
    origin = torch.where(refined.origin < 0, -1, kept[refined.origin.clamp(min=0)])
    return refined.parameters, origin


def follow(moments: dict[str, Tensor], origin: Tensor) -> dict[str, Tensor]:
    """Adam's state of a parameter after its rows were resampled: new rows begin without momentum."""
    moved = dict(moments)
    for name in MOMENTS:
        rows = moments[name][origin.clamp(min=0)]
        rows[origin < 0] = 0.0
        moved[name] = rows
    return moved
