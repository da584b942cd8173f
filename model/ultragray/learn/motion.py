"""Where modes of motion come from: a sweep of which each frame has a number, or a chest that is built in.

`fit_motion` begins with a scene that was trained as if its tissue were still, a blur of all phases, and learns the
field of one mode together with the Gaussians: the frame of a pose and a number is the scene at that phase. The field
costs what it bends, so that it is smooth where frames say nothing. `chest_motion` needs no frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.learn.sweep import Sweep
from ultragray.learn.training.losses import image_loss
from ultragray.rendering.frames import render
from ultragray.scene.deformation import LEAST_SIDE, Displacement, spline_coefficients
from ultragray.scene.gaussians import PARAMETERS, GaussianScene
from ultragray.scene.info import SceneInfo, with_summary
from ultragray.scene.modes import FIT_STEPS, MAX_SIDE, Mode, Motion, Moving

Numbers = npt.NDArray[np.float64]

SPACING_MM, CHEST_SPACING_MM = 15.0, 6.0  # between splines: of a field that is learned, of the chest
BATCH = 4
RATES = {"means": 1e-2, "scales": 1e-2, "quats": 1e-2, "transmittances": 1e-2, "sh0": 2e-2, "shN": 1e-4}
FIELD_RATE_MM = 0.25  # a step, of the displacement from end to end
BENDING = 1e-3  # price of a squared second difference of the field, 1/mm²
TEXTURE = 0.5  # share of 1 − SSIM in the loss


def read_numbers(path: str | Path, count: int) -> Numbers:  # [F]
    """A number a line, one for each of at least `count` frames of a recording. Raises DatasetInvalid."""
    try:
        numbers = np.loadtxt(path, dtype=np.float64, ndmin=1, delimiter=",")
    except (OSError, ValueError) as error:
        raise DatasetInvalid(f"{path}: {error}") from error
    if numbers.ndim != 1 or len(numbers) < count or not np.isfinite(numbers).all():
        raise DatasetInvalid(
            f"{path}: it must hold one finite number a line for each of {count} frames, got {list(numbers.shape)}"
        )
    return numbers


def fit_motion(
    scene: GaussianScene,
    sweep: Sweep,
    numbers: Numbers,  # [F] of its frames
    *,
    name: str = "breathing",
    surrogate: str = "",
    steps: int = FIT_STEPS,
    spacing_mm: float = SPACING_MM,
    report: Callable[[int, float], None] = lambda step, loss: None,
) -> GaussianScene:
    """The scene with one mode of motion, at rest at the median number.

    Raises InvalidArgument where all numbers are the same.
    """
    low, high = float(numbers.min()), float(numbers.max())
    if len(numbers) != len(sweep) or not low < high:
        raise InvalidArgument(
            f"numbers must be {len(sweep)}, one for each frame, and differ; got {len(numbers)}, from {low:g} to "
            f"{high:g}",
            field="surrogate",
        )
    mode = Mode(name, low, high, float(np.median(numbers)), surrogate=surrogate)
    origin, sides = _grid(scene.info, spacing_mm)
    field = torch.zeros((1, *sides, 3), requires_grad=True)  # mm from end to end
    splats: dict[str, Any] = {key: tensor.detach().clone().requires_grad_() for key, tensor in scene.splats.items()}
    rates = [
        *({"params": [splats[key]], "lr": RATES[key]} for key in PARAMETERS),
        {"params": [field], "lr": FIELD_RATE_MM},
    ]
    optimizer = torch.optim.Adam(rates)
    decay = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 0.05 ** (step / steps))
    generator = torch.Generator().manual_seed(0)
    trained = GaussianScene(**splats, info=scene.info)
    truth = torch.from_numpy(sweep.images)
    for step in range(steps):
        batch = torch.randperm(len(sweep), generator=generator)[:BATCH].numpy()
        shares = torch.from_numpy(((numbers[batch] - mode.rest) / mode.span).astype(np.float32))
        moved = Displacement.on_grid(shares[:, None, None, None, None] * field, origin, spacing_mm)
        frames = render(
            trained.under(moved),
            sweep.probe,
            sweep.poses[batch],
            height=sweep.height,
            width=sweep.width,
            outputs=("bmode",),
        )
        loss = image_loss(frames["bmode"], truth[batch].float() / 255.0, TEXTURE) + BENDING * _bending(field)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        decay.step()
        report(step + 1, float(loss.detach()))
    coefficients = (field.detach() / mode.span).numpy()
    learned: dict[str, Any] = {key: tensor.detach() for key, tensor in splats.items()}
    motion = Motion((mode,), tuple(origin.tolist()), (spacing_mm,) * 3)
    return with_motion(replace(scene, **learned), motion, coefficients)


def chest_motion(info: SceneInfo, depth_mm: float, *, spacing_mm: float = CHEST_SPACING_MM) -> tuple[Motion, Any]:
    """A chest or belly that breathes by `depth_mm` along the scene's z as its number goes from 0 to 1.

    Deep tissue moves as a whole, away from the skin under the probe, which stays: the motion rises over the first third
    of the scene's depth, where tissue is drawn apart.
    """
    origin, sides = _grid(info, spacing_mm)
    low, high = info.bounds_min_mm[2], info.bounds_max_mm[2]
    nodes = origin[2] + spacing_mm * np.arange(1, sides[2] - 1)  # through which the splines go
    share = np.clip((nodes - low) / max((high - low) / 3.0, spacing_mm), 0.0, 1.0)
    samples = torch.zeros((1, *(side - 2 for side in sides), 3), dtype=torch.float64)
    samples[..., 2] = torch.from_numpy(depth_mm * (1.0 - np.cos(math.pi * share)) / 2.0)
    motion = Motion((Mode("breathing", 0.0, 1.0),), tuple(origin.tolist()), (spacing_mm,) * 3)
    return motion, spline_coefficients(samples)


def with_motion(scene: GaussianScene, motion: Motion, coefficients: Any) -> GaussianScene:
    """The scene with these modes instead of its own; [M, X, Y, Z, 3] mm."""
    moving = Moving(motion, np.ascontiguousarray(coefficients, np.float32))
    info = with_summary(scene.info, scene.means.detach().double().numpy(), scene.sh_degree)
    return replace(scene, info=replace(info, motion=motion), moving=moving)


def _grid(info: SceneInfo, spacing_mm: float) -> tuple[npt.NDArray[np.float64], tuple[int, ...]]:
    """The first spline (mm) and the sides of a grid that holds the Gaussians, with a spline beyond at each end."""
    low, high = np.asarray(info.bounds_min_mm), np.asarray(info.bounds_max_mm)
    sides = np.maximum(np.ceil((high - low) / spacing_mm).astype(int) + 3, LEAST_SIDE)
    if sides.max() > MAX_SIDE:
        raise InvalidArgument(
            f"spacing_mm must be at least {(high - low).max() / (MAX_SIDE - 3):.1f} for a scene of this size, got "
            f"{spacing_mm:g}",
            field="spacing_mm",
        )
    return (low + high - spacing_mm * (sides - 1)) / 2.0, tuple(sides.tolist())


def _bending(field: Tensor) -> Tensor:  # [1, X, Y, Z, 3] -> scalar
    """Mean squared second difference along each axis of the grid."""
    return torch.stack([field.diff(n=2, dim=axis).square().mean() for axis in (1, 2, 3)]).sum()
