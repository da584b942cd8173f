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

import cv2
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
from ultragray.scene.gaussians import PARAMETERS, GaussianScene, no_smaller_than_held
from ultragray.scene.modes import Mode
from ultragray.scene.motion_settings import FIT_STEPS, GIVEN_SPACING_MM, SPACING_MM, MotionSettings
from ultragray.scene.shapes import LabelShape, TubeShape

Numbers = npt.NDArray[np.float64]
Report = Callable[[int, float], None]  # of the steps done and the loss

BATCH = 8  # frames of a step
FINDING_BATCH = 4  # where numbers are found, too: with eight they were found worse in a small sweep
RATES = {"means": 1e-2, "scales": 1e-2, "quats": 1e-2, "transmittances": 1e-2, "sh0": 2e-2, "shN": 1e-4}
FIELD_RATE_MM = 0.25  # a step, of the displacement from end to end
BENDING = 1e-3  # price of a squared second difference of the field, 1/mm²
TEXTURE = 0.05  # share of 1 − SSIM in the loss
LEVELS = tuple(np.linspace(-1.5, 1.5, 25).tolist())  # shares of the field among which those of frames are looked for
ROUNDS, STEADY = 6, 0.1  # how often, and the price of a squared step of them from frame to frame
FLOW_PIXELS = 1.5  # standard deviation by which frames are smoothed, before they are compared
BEGIN_MM = 3.0  # by which deep tissue is taken to move for a share of 1


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
    settings: MotionSettings,
    *,
    sweep: Sweep | None = None,
    numbers: Numbers | None = None,  # [F] of its frames; None: they are found
    surrogate: str = "",
    field: Field | None = None,
    report: Report = lambda step, loss: None,
) -> Added:
    """The scene with one mode more: of the sweep, of a field, or built in. Raises InvalidArgument."""
    settings.check_source(sweep=sweep is not None, field=field is not None)
    name = settings.mode_name(scene.info.motion)
    if sweep is not None:
        spacing_mm = settings.spacing_mm or SPACING_MM
        options: Any = {"name": name, "steps": settings.steps, "spacing_mm": spacing_mm, "report": report}
        if numbers is None:
            moving, levels = find_motion(scene, sweep, **options)
            return Added(moving, numbers=levels)
        return Added(fit_motion(scene, sweep, numbers, surrogate=surrogate, **options))
    tube, spacing_mm = None, settings.spacing_mm or GIVEN_SPACING_MM
    if settings.chest_mm is not None:
        field = chest(scene.info, settings.chest_mm)
    elif settings.pulse_mm is not None:
        vessel = settings.vessel
        assert isinstance(vessel, (LabelShape, TubeShape))
        tube = vessel if isinstance(vessel, TubeShape) else vessel_of(scene, vessel)
        spacing_mm = settings.spacing_mm or pulsation_spacing_mm(scene, tube)
        field = pulsation(tube, settings.pulse_mm)
    assert field is not None
    return Added(*with_mode(scene, Mode(name, 0.0, 1.0), field, spacing_mm), tube=tube)


def read_numbers(path: str | Path) -> Numbers:  # [R]
    """The numbers of a recording's frames from a file with one a line. Raises DatasetInvalid."""
    try:
        return np.loadtxt(path, dtype=np.float64, ndmin=1, delimiter=",")
    except (OSError, ValueError) as error:
        raise DatasetInvalid(f"{path}: {error}") from error


def numbers_of(sweep: Sweep, numbers: npt.ArrayLike, source: str) -> Numbers:  # [R] of the recording -> [F]
    """Those of a sweep's frames, which may be a part of the recording's. Raises DatasetInvalid."""
    values, count = np.asarray(numbers, np.float64), int(sweep.frame_numbers.max()) + 1
    if values.ndim != 1 or len(values) < count or not np.isfinite(values).all():
        raise DatasetInvalid(
            f"{source}: there must be one finite number for each of {count} frames, got {list(values.shape)}"
        )
    return values[sweep.frame_numbers]


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
    """As `fit_motion`, where nothing told the numbers of the frames: they are found, greater ones for deeper tissue.

    They begin with how tissue goes from frame to frame (`depths_in_time`). Then, by turns, all is learned with these
    for a while, and each frame gets the number of LEVELS at which the scene looks most like it.
    """
    in_time = np.argsort(sweep.frame_numbers, kind="stable")
    levels = torch.zeros(len(sweep))
    levels[in_time] = torch.from_numpy(depths_in_time(sweep.images[in_time])).float()
    fit = _Fit(scene, sweep, Grid.over(scene.info, spacing_mm), FINDING_BATCH)
    fit.begin_with(torch.from_numpy(sweep.poses[:, :3, 2].mean(axis=0)).float())
    for step in range(steps):
        if step and step * ROUNDS // steps > (step - 1) * ROUNDS // steps:
            levels = fit.levels(in_time)
        report(step + 1, fit.step(step / steps, levels))
    shares = levels.double().numpy()
    low, span = shares.min(), np.ptp(shares)
    if not span > 0.0:
        raise InvalidArgument("the frames tell of no motion: their numbers are all the same", field="surrogate")
    mode = Mode(name, 0.0, 1.0, float(-low / span), surrogate="found in the frames")
    return fit.scene_with(mode, fit.field.detach() * span), (shares - low) / span


def depths_in_time(images: npt.NDArray[np.uint8]) -> Numbers:  # [F, H, W] in time -> [F] from -1 to 1
    """How deep tissue is in each frame, but for what changes slowly, as anatomy does along a sweep.

    From a frame to the next, rows go down by s·w with w from 0 at the face to 1: by least squares, s is that of which
    −s·w·∂I/∂row explains most of what changes. Their sum, less its mean over one and a half of the strongest period,
    is the depth.
    """
    smooth = np.stack([cv2.GaussianBlur(image.astype(np.float32), (0, 0), FLOW_PIXELS) for image in images])
    slopes = np.gradient(smooth, axis=1) * np.linspace(0.0, 1.0, images.shape[1])[None, :, None]
    slopes = (slopes[1:] + slopes[:-1]) / 2.0
    moved = -(slopes * np.diff(smooth, axis=0)).sum(axis=(1, 2)) / np.maximum(np.square(slopes).sum(axis=(1, 2)), 1e-9)
    depth = np.concatenate([[0.0], np.cumsum(moved)])
    cycles = 1 + int(np.abs(np.fft.rfft(moved - moved.mean()))[1:].argmax())
    half = min(round(0.75 * len(images) / cycles), len(images) - 1)
    window = np.hanning(2 * half + 3)[1:-1]
    depth -= np.convolve(np.pad(depth, half, mode="reflect"), window / window.sum(), "valid")
    depths: Numbers = depth / max(float(np.abs(depth).max()), 1e-9)
    return depths


class _Fit:
    """Gaussians and a field of one mode, learned together."""

    def __init__(self, scene: GaussianScene, sweep: Sweep, grid: Grid, batch: int = BATCH) -> None:
        self._scene, self._sweep, self._grid, self._batch = scene, sweep, grid, batch
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

    @torch.no_grad()
    def levels(self, in_time: npt.NDArray[np.int64]) -> Tensor:  # [F] frames -> [F] shares of the field
        """The share at which each frame looks most like the scene, those that follow each other alike: the path through
        all frames in time whose squared errors and squared steps (STEADY) cost least.
        """
        places = torch.from_numpy(in_time)
        errors = torch.zeros((len(places), len(LEVELS)))
        for batch in torch.split(places, 16):
            truth = self._truth[batch].float() / 255.0
            for column, level in enumerate(LEVELS):
                rendered = self._rendered(batch, torch.full((len(batch),), level))
                errors[batch, column] = (rendered - truth).square().mean(dim=(1, 2))
        errors = errors[places]  # in time
        errors /= (errors.amax(dim=1) - errors.amin(dim=1)).mean()
        steps = STEADY * (torch.tensor(LEVELS)[:, None] - torch.tensor(LEVELS)).square()
        reached = errors[0]
        before: list[Tensor] = []
        for error in errors[1:]:
            least = (reached + steps).min(dim=1)
            reached, before = error + least.values, [*before, least.indices]
        path = [int(reached.argmin())]
        for come_from in reversed(before):
            path.append(int(come_from[path[-1]]))
        shares = torch.zeros(len(places))
        shares[places] = torch.tensor(LEVELS)[path[::-1]]
        return shares

    def step(self, done: float, shares: Tensor) -> float:  # [F] -> loss
        """One step of a batch, when a share of all steps is done."""
        batch = torch.randperm(len(shares), generator=self._generator)[: self._batch]
        truth = self._truth[batch].float() / 255.0
        loss = image_loss(self._rendered(batch, shares[batch]), truth, TEXTURE) + BENDING * _bending(self.field)
        for group, rate in zip(self._optimizer.param_groups, self._rates, strict=True):
            group["lr"] = rate * 0.05**done
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self._optimizer.step()
        return float(loss.detach())

    def _rendered(self, frames: Tensor, shares: Tensor) -> Tensor:  # [C] both -> [C, H, W]
        sweep = self._sweep
        moved = self._grid.displacement(shares[:, None, None, None, None] * self.field)
        return render(
            self._trained.under(moved),
            sweep.probe,
            sweep.poses[frames.numpy()],
            height=sweep.height,
            width=sweep.width,
            outputs=("bmode",),
        )["bmode"]

    def scene_with(self, mode: Mode, field: Tensor) -> GaussianScene:  # [1, X, Y, Z, 3] mm for one unit
        """What was learned, as a scene with one mode more."""
        learned: dict[str, Any] = no_smaller_than_held({key: tensor.detach() for key, tensor in self._splats.items()})
        return with_splines(replace(self._scene, **learned), mode, self._grid, field[0])


def _bending(field: Tensor) -> Tensor:  # [1, X, Y, Z, 3] -> scalar
    """Mean squared second difference along each axis of the grid."""
    return torch.stack([field.diff(n=2, dim=axis).square().mean() for axis in (1, 2, 3)]).sum()
