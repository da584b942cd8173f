"""Where modes of motion come from: a sweep, whose frames have a number each or not, or a field that is given.

`fit_motion` begins with a scene that was trained as if its tissue were still, a blur of all phases, and learns the
field of one mode together with the Gaussians: the frame of a pose and a number is the scene at that phase. The field
costs what it bends, so that it is smooth where frames say nothing. `add_motion` does all of it, by the settings of a
mode.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ultragray.contract import to_dict
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.learn.motion_fields import (
    Field,
    Grid,
    Residual,
    chest,
    pulsation,
    pulsation_spacing_mm,
    vessel_of,
    with_mode,
    with_splines,
)
from ultragray.learn.sweep import Sweep
from ultragray.learn.training.losses import image_loss
from ultragray.rendering.frames import render
from ultragray.scene.gaussians import PARAMETERS, GaussianScene
from ultragray.scene.modes import Mode
from ultragray.scene.motion_settings import FIT_STEPS, GIVEN_SPACING_MM, SPACING_MM, MotionSettings
from ultragray.scene.shapes import LabelShape, TubeShape

Numbers = npt.NDArray[np.float64]
Report = Callable[[int, float], None]  # of the steps done and the loss

BATCH = 4
RATES = {"means": 1e-2, "scales": 1e-2, "quats": 1e-2, "transmittances": 1e-2, "sh0": 2e-2, "shN": 1e-4}
FIELD_RATE_MM = 0.25  # a step, of the displacement from end to end
BENDING = 1e-3  # price of a squared second difference of the field, 1/mm²
TEXTURE = 0.5  # share of 1 − SSIM in the loss
LEVEL_RATE = 0.1  # a step, of numbers that are to be found
STEADY = 1e-3  # price of their squared second difference in time
FIRST, BEGIN_MM = 0.15, 3.0  # share of the steps that look for numbers alone, and the field that they do it by


class Added(NamedTuple):
    """A scene with a mode more, and how that was found."""

    scene: GaussianScene
    residual: Residual | None = None  # of a field that was given
    numbers: Numbers | None = None  # [F] of the frames, where they were to be found
    tube: TubeShape | None = None  # of a vessel

    def facts(self) -> dict[str, Any]:
        """All but the scene, as JSON has it."""
        assert self.scene.info.motion is not None
        modes, residual = self.scene.info.motion.modes, self.residual
        return {
            "modes": to_dict(modes),
            "residual_mm": None if residual is None else {"rms": residual.rms_mm, "most": residual.most_mm},
            "vessel": None if self.tube is None else to_dict(self.tube),
            "numbers": None if self.numbers is None else self.numbers.tolist(),
        }


def add_motion(
    scene: GaussianScene,
    asked: MotionSettings,
    *,
    sweep: Sweep | None = None,
    numbers: Numbers | None = None,  # [F] of its frames; None: they are found
    surrogate: str = "",
    field: Field | None = None,
    report: Report = lambda step, loss: None,
) -> Added:
    """The scene with one mode more: of the sweep, of a field, or built in. Raises InvalidArgument."""
    asked.check_source(sweep=sweep is not None, field=field is not None)
    name = asked.mode_name(scene.info.motion)
    if sweep is not None:
        spacing_mm = asked.spacing_mm or SPACING_MM
        options: Any = {"name": name, "steps": asked.steps, "spacing_mm": spacing_mm, "report": report}
        if numbers is None:
            moving, found = find_motion(scene, sweep, **options)
            return Added(moving, numbers=found)
        return Added(fit_motion(scene, sweep, numbers, surrogate=surrogate, **options))
    tube, spacing_mm = None, asked.spacing_mm or GIVEN_SPACING_MM
    if asked.chest_mm is not None:
        field = chest(scene.info, asked.chest_mm)
    elif asked.pulse_mm is not None:
        vessel = asked.vessel
        assert isinstance(vessel, (LabelShape, TubeShape))
        tube = vessel if isinstance(vessel, TubeShape) else vessel_of(scene, vessel)
        spacing_mm = asked.spacing_mm or pulsation_spacing_mm(scene, tube)
        field = pulsation(tube, asked.pulse_mm)
    assert field is not None
    return Added(*with_mode(scene, Mode(name, 0.0, 1.0), field, spacing_mm), tube=tube)


def read_numbers(path: str | Path, sweep: Sweep) -> Numbers:  # [F]
    """The numbers of a sweep's frames from a file with one a line, one for each of the recording's.

    Raises DatasetInvalid.
    """
    try:
        numbers = np.loadtxt(path, dtype=np.float64, ndmin=1, delimiter=",")
    except (OSError, ValueError) as error:
        raise DatasetInvalid(f"{path}: {error}") from error
    return numbers_of(sweep, numbers, str(path))


def numbers_of(sweep: Sweep, numbers: npt.ArrayLike, source: str) -> Numbers:  # [R] of the recording -> [F]
    """Those of a sweep's frames, which may be a part of the recording's. Raises DatasetInvalid."""
    given, count = np.asarray(numbers, np.float64), int(sweep.frame_numbers.max()) + 1
    if given.ndim != 1 or len(given) < count or not np.isfinite(given).all():
        raise DatasetInvalid(
            f"{source}: there must be one finite number for each of {count} frames, got {list(given.shape)}"
        )
    return given[sweep.frame_numbers]


def fit_motion(
    scene: GaussianScene,
    sweep: Sweep,
    numbers: Numbers,  # [F] of its frames
    *,
    name: str = "breathing",
    surrogate: str = "",
    steps: int = FIT_STEPS,
    spacing_mm: float = SPACING_MM,
    report: Report = lambda step, loss: None,
) -> GaussianScene:
    """The scene with one mode of motion more, at rest at the median number; modes that it has are at rest.

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
    shares = torch.from_numpy(((numbers - mode.rest) / mode.span).astype(np.float32))
    fit = _Fit(scene, sweep, Grid.over(scene.info, spacing_mm))
    for step in range(steps):
        report(step + 1, fit.step(step / steps, shares))
    return fit.scene_with(mode, fit.field.detach() / mode.span)


def find_motion(
    scene: GaussianScene,
    sweep: Sweep,
    *,
    name: str = "breathing",
    steps: int = FIT_STEPS,
    spacing_mm: float = SPACING_MM,
    report: Report = lambda step, loss: None,
) -> tuple[GaussianScene, Numbers]:  # [F] from 0 to 1
    """As `fit_motion`, where nothing told the numbers of the frames: they are found, by how frames disagree with the
    still scene where poses agree, and greater ones have tissue farther along the beams.

    Field and numbers enter as a product, of which neither can begin at 0: deep tissue is taken to move along the beams
    until numbers have been found for that (FIRST); from then on all is learned together. Frames that follow each other
    have numbers alike (STEADY).
    """
    fit = _Fit(scene, sweep, Grid.over(scene.info, spacing_mm))
    beams = torch.from_numpy(sweep.poses[:, :3, 2].mean(axis=0)).float()
    fit.begin_with(beams)
    levels = torch.zeros(len(sweep), requires_grad=True)
    optimizer = torch.optim.Adam([levels], lr=LEVEL_RATE)
    in_time = torch.from_numpy(np.argsort(sweep.frame_numbers, kind="stable"))
    for step in range(steps):
        done = step / steps
        optimizer.zero_grad()
        (STEADY * levels[in_time].diff(n=2).square().mean()).backward()  # type: ignore[no-untyped-call]
        loss = fit.step(done, levels, only_shares=done < FIRST)
        optimizer.param_groups[0]["lr"] = LEVEL_RATE * 0.05**done
        optimizer.step()
        report(step + 1, loss)
    found, field = levels.detach().double().numpy(), fit.field.detach()
    if float((field @ beams).mean()) < 0.0:
        found, field = -found, -field
    low, span = found.min(), np.ptp(found)
    if not span > 0.0:
        raise InvalidArgument("the frames tell of no motion: their numbers are all the same", field="surrogate")
    mode = Mode(name, 0.0, 1.0, float(-low / span), surrogate="found in the frames")
    return fit.scene_with(mode, field * span), (found - low) / span


class _Fit:
    """Gaussians and a field of one mode, learned together."""

    def __init__(self, scene: GaussianScene, sweep: Sweep, grid: Grid) -> None:
        self._scene, self._sweep, self._grid = scene, sweep, grid
        self.field = torch.zeros((1, *grid.sides, 3), requires_grad=True)  # mm, of a share of 1
        self._splats: dict[str, Any] = {
            key: tensor.detach().clone().requires_grad_() for key, tensor in scene.splats.items()
        }
        self._trained = GaussianScene(**self._splats, info=scene.info)
        rates = [
            *({"params": [self._splats[key]], "lr": RATES[key]} for key in PARAMETERS),
            {"params": [self.field], "lr": FIELD_RATE_MM},
        ]
        self._optimizer = torch.optim.Adam(rates)
        self._rates = [group["lr"] for group in self._optimizer.param_groups]
        self._generator = torch.Generator().manual_seed(0)
        self._truth = torch.from_numpy(sweep.images)

    def begin_with(self, beams: Tensor) -> None:  # [3]
        """A field by which tissue moves along the beams, by up to BEGIN_MM where it is deep."""
        nodes = [
            torch.arange(side) * spacing for side, spacing in zip(self._grid.sides, self._grid.spacing_mm, strict=True)
        ]
        depth = torch.stack(torch.meshgrid(*nodes, indexing="ij"), dim=-1).float() @ beams
        share = (depth - depth.min()) / (depth.max() - depth.min())
        self.field.data = (BEGIN_MM * share[..., None] * beams)[None]

    def step(self, done: float, shares: Tensor, *, only_shares: bool = False) -> float:  # [F] -> loss
        """One step of a batch, when a share of all steps is done; gradients reach the frames' shares of the field."""
        sweep = self._sweep
        batch = torch.randperm(len(sweep), generator=self._generator)[:BATCH].numpy()
        moved = self._grid.displacement(shares[batch, None, None, None, None] * self.field)
        frames = render(
            self._trained.under(moved),
            sweep.probe,
            sweep.poses[batch],
            height=sweep.height,
            width=sweep.width,
            outputs=("bmode",),
        )
        truth = self._truth[batch].float() / 255.0
        loss = image_loss(frames["bmode"], truth, TEXTURE) + BENDING * _bending(self.field)
        for group, rate in zip(self._optimizer.param_groups, self._rates, strict=True):
            group["lr"] = rate * 0.05**done
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if not only_shares:
            self._optimizer.step()
        return float(loss.detach())

    def scene_with(self, mode: Mode, field: Tensor) -> GaussianScene:  # [1, X, Y, Z, 3] mm for one unit
        """What was learned, as a scene with one mode more."""
        learned: dict[str, Any] = {key: tensor.detach() for key, tensor in self._splats.items()}
        return with_splines(replace(self._scene, **learned), mode, self._grid, field[0])


def _bending(field: Tensor) -> Tensor:  # [1, X, Y, Z, 3] -> scalar
    """Mean squared second difference along each axis of the grid."""
    return torch.stack([field.diff(n=2, dim=axis).square().mean() for axis in (1, 2, 3)]).sum()
