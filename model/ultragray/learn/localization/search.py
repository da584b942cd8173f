"""What a motion of the probe within its image plane does to a frame, by the frame alone: its pixels slide.

Shadows and gain slide along, which they would not quite do in a frame rendered there. To tell the next step of a search
that is near enough, and it takes no rendering.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from torch.quasirandom import SobolEngine

from ultragray.errors import InvalidArgument
from ultragray.geometry.image_size import check_image_size
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import Probe
from ultragray.learn.localization.settings import NEAR_DEG, NEAR_MM, Localization, LocalizationSettings
from ultragray.learn.sweep import pixel_positions_mm
from ultragray.learn.training.poses import turned_by
from ultragray.rendering.frames import render
from ultragray.rendering.limits import UNLIMITED, Limits
from ultragray.scene.gaussians import GaussianScene

IN_PLANE = (0, 2, 4)  # of the six numbers of a motion: shifts along lateral and axial axis, the turn about elevation


def places_after(probe: Probe, motions: Tensor, rows: int, columns: int) -> Tensor:
    """Where in a frame [rows, columns] the pixels of frames after motions [S, 4, 4] lie: [S, rows, columns, 2].

    The two numbers are column and row in [-1, 1], as functional.grid_sample() takes them.
    """
    pixels = pixel_positions_mm(probe, rows, columns)
    moves = motions.numpy()
    moved = pixels @ moves[:, :3, :3].transpose(0, 2, 1) + moves[:, None, :3, 3]
    depth, across = (share.reshape(rows, columns) for share in probe.lines.coordinates(pixels[:, 0], pixels[:, 2]))
    rows_after, columns_after = probe.lines.coordinates(moved[..., 0], moved[..., 2])
    places = np.stack(
        [
            2.0 * (columns_after - across[0, 0]) / (across[0, -1] - across[0, 0]) - 1.0,
            2.0 * (rows_after - depth[0, 0]) / (depth[-1, 0] - depth[0, 0]) - 1.0,
        ],
        axis=-1,
    )
    return torch.from_numpy(places.reshape(len(motions), rows, columns, 2)).float()


def slid(frames: Tensor, places: Tensor) -> Tensor:  # [K, H, W], [S, H, W, 2] -> [K, S, H, W]
    """Each frame after each step, by places_after(); what comes in from outside is as the edge was."""
    count, rows, columns = frames.shape
    repeated = frames[:, None].expand(count, len(places), rows, columns).reshape(-1, 1, rows, columns)
    grid = places.repeat(count, 1, 1, 1)
    after = functional.grid_sample(repeated, grid, mode="bicubic", padding_mode="border", align_corners=True)
    return after.reshape(count, len(places), rows, columns)


# Small motions of the probe: shifts along its own axes and turns about the middle of its image, all in mm.
#
# A turn is given by the way that it moves a point at the typical distance from the middle, so that steps of all six
# numbers weigh alike.

GRID = 16  # rows and columns of the image that are looked at


@dataclass(frozen=True, eq=False)
class Motions:
    """Motions of one probe."""

    middle_mm: Tensor  # [3] of its image, in the probe frame, float64
    lever_mm: float  # typical distance of a pixel from there

    @classmethod
    def of(cls, probe: Probe) -> Motions:
        positions = torch.from_numpy(pixel_positions_mm(probe, GRID, GRID))
        middle = positions.mean(dim=0)
        return cls(middle, float((positions - middle).square().sum(dim=1).mean().sqrt()))

    def moved(self, poses: Tensor, steps: Tensor) -> Tensor:  # [..., 4, 4], [..., 6] mm -> [..., 4, 4]
        return poses @ self.of_steps(steps)

    def of_steps(self, steps: Tensor) -> Tensor:  # [..., 6] mm -> [..., 4, 4]
        """In the probe frame: three shifts and three turns, about lateral, elevation and axial axis."""
        shifts, turns = steps[..., :3], steps[..., 3:] / self.lever_mm
        rotations = turned_by(turns.reshape(-1, 3)).reshape(*turns.shape[:-1], 3, 3)
        motions = torch.zeros(*steps.shape[:-1], 4, 4, dtype=steps.dtype)
        motions[..., :3, :3] = rotations
        motions[..., :3, 3] = self.middle_mm - rotations @ self.middle_mm + shifts
        motions[..., 3, 3] = 1.0
        return motions

    def step_between(self, before: Tensor, after: Tensor) -> tuple[float, float]:  # [4, 4] both
        """How far the middle of the image moves, mm, and the image turns, degrees."""
        middle = torch.cat([self.middle_mm, torch.ones(1, dtype=torch.float64)])
        shift_mm = float(((after - before) @ middle).norm())
        cosine = (float((before[:3, :3].T @ after[:3, :3]).trace()) - 1.0) / 2.0
        return shift_mm, math.degrees(math.acos(max(-1.0, min(1.0, cosine))))

    def degrees(self, turns_mm: Tensor) -> Tensor:
        return torch.rad2deg(turns_mm / self.lever_mm)


# What of a frame is compared: its structures at some size, whatever gain and shadow made of their brightness.
#
# A frame is smoothed, its mean over a wider neighbourhood is taken off, and what is left is divided by its own
# strength there. Coarse structures match from far away, fine ones tell the place exactly.

NEIGHBOURHOOD = 3.0  # times as wide as the smoothing
LEAST_STRENGTH = 0.02  # of grey values in [0, 1]: what varies less is noise
REACH = 2.5  # standard deviations of a Gaussian that are summed
LEAST_SIGMA = 0.3  # pixels: less smooths nothing


@dataclass(frozen=True)
class Scale:
    """Frames of `rows` x `columns` pixels, smoothed by Gaussians of `sigma_rows` and `sigma_columns` pixels."""

    rows: int
    columns: int
    sigma_rows: float
    sigma_columns: float

    @classmethod
    def of(cls, probe: Probe, rows: int, columns: int, smoothing_mm: float) -> Scale:
        """Smoothed by so many mm along depth, and across in the middle of the image."""
        middle = pixel_positions_mm(probe, rows, columns).reshape(rows, columns, 3)[rows // 2]
        across_mm = float(((middle[1:] - middle[:-1]) ** 2).sum(axis=1).mean() ** 0.5)
        return cls(rows, columns, smoothing_mm * rows / probe.scan_line_length_mm, smoothing_mm / across_mm)

    def resized(self, image: Tensor) -> Tensor:  # [H, W] -> [rows, columns]
        """A larger frame with the pixels of this scale: means of what they cover."""
        return functional.interpolate(image[None, None], size=(self.rows, self.columns), mode="area")[0, 0]

    def appearance(self, frames: Tensor) -> Tensor:  # [C, rows, columns] in [0, 1] -> [C, rows, columns]
        """The structures of frames, of strength 1 where there are any."""
        smooth = self._blurred(frames, 1.0)
        structure = smooth - self._blurred(smooth, NEIGHBOURHOOD)
        strength = self._blurred(structure.square(), NEIGHBOURHOOD)
        return structure / (strength + LEAST_STRENGTH**2).sqrt()

    def _blurred(self, frames: Tensor, times: float) -> Tensor:
        rows = _smoother(self.rows, times * self.sigma_rows)
        return rows @ frames @ _smoother(self.columns, times * self.sigma_columns).mT


@lru_cache(maxsize=32)
def _smoother(count: int, sigma: float) -> Tensor:  # [count, count]
    """The matrix that smooths so many values by a Gaussian; beyond the ends the outermost values go on."""
    if sigma < LEAST_SIGMA:
        return torch.eye(count)
    reach = max(1, math.ceil(REACH * sigma))
    offsets = torch.arange(-reach, reach + 1)
    weights = torch.exp(-0.5 * (offsets / sigma).square())
    places = (torch.arange(count)[:, None] + offsets).clamp(0, count - 1)
    return torch.zeros(count, count).scatter_add_(1, places, (weights / weights.sum()).expand(count, -1))


# localize(): the pose at which a scene looks like a real frame, by Levenberg and Marquardt from coarse to fine.
#
# How each pixel changes with the pose comes from small frames on either side of it (on one side only they mislead),
# twelve of them. Six are of motions within the image plane: these the frame at the pose tells itself, and only to say
# how certain the result is are they rendered. The steps that follow bring one frame each, which corrects the changes
# along the step (Broyden 1965); they are taken anew where such a step fails or has arrived, and after a few: of
# coarse frames, where the place is far, after each. A backward pass would tell how one number changes, the sum of all
# squares; to get on with that alone takes many times as many steps.
#
# Fine structures hold a search fast at places a millimetre beside the right one. So it goes back to smoother frames
# once before it ends: from such a place they lead on.

Rendered = Callable[[Tensor, int, int], Tensor]  # [C, 4, 4], rows, columns -> [C, rows, columns] in [0, 1]

FOUND_SIMILARITY = 0.5
SEED = 0
BLOCKS = (8, 6)  # of the image, along depth and across, that err independently of each other
LEAST_PIXELS = 32  # of a side of a frame that can be found


@dataclass(frozen=True)
class Stage:
    """At most so many steps at one scale.

    `probing_mm` is how far the frames on either side are taken from a pose, and `corrected` how many steps may follow
    before they are taken anew.
    """

    rows: int
    columns: int
    smoothing_mm: float
    steps: int
    probing_mm: float
    corrected: int
    kept: int = 1  # of the poses that it begins with


COARSE = Stage(64, 48, 3.0, 4, 1.0, 1, kept=2)
MIDDLE = Stage(64, 48, 1.5, 5, 0.6, 2)
FINE = Stage(128, 96, 0.8, 4, 0.3, 4)
LAST = Stage(128, 96, 0.5, 6, 0.2, 4)
STAGES = (COARSE, MIDDLE, FINE, MIDDLE, FINE, LAST)
MOST_BEGUN = 6  # poses at the coarse stage
MOST_TRIED = 64  # poses that are looked at before, where the start is less certain
START_DAMPING, MORE_DAMPING, LESS_DAMPING = 1e-2, 6.0, 3.0
LONGEST_STEP_MM = 4.0
SHORT_STEP = 0.1  # of the smoothing: a stage whose steps are shorter has arrived
SHORT_LAST_STEP = 0.02  # likewise, of the last stage


def localize(
    scene: GaussianScene,
    image: Any,
    start: Any,
    *,
    probe: Probe | None = None,
    within_mm: float = NEAR_MM,
    within_deg: float = NEAR_DEG,
    backend: str = "auto",
    limits: Limits = UNLIMITED,
) -> Localization:
    """The pose of a real frame [H, W] in a scene, from a start [4, 4] (mm, probe→scene) that is about right.

    `image` is grey values, an array or a tensor, uint8 or in [0, 1], in the layout of the scene's frames: rows along
    depth, columns across scan lines, not scan-converted. Its gain and contrast may differ from the scene's. `probe`
    took it (None: the one that the scene was trained with). The start may be off by `within_mm` and `within_deg`: more
    than 3 mm and 5° costs more time.
    Raises InvalidArgument for an image that is none or smaller than 32 pixels a side, InvalidPose, InvalidProbe, and
    what render() raises.
    """
    frame = _checked_image(image)
    LocalizationSettings(within_mm=within_mm, within_deg=within_deg)
    told = check_poses(start, field="start")
    if len(told) != 1:
        raise InvalidArgument(f"start must be one pose, got {len(told)}", field="start")
    first, at_rest = torch.from_numpy(scene.poses_at_rest(told)), scene.at_rest()
    known = scene.info.probe_or(probe)
    motions = Motions.of(known)

    def rendered(poses: Tensor, rows: int, columns: int) -> Tensor:
        frames = render(
            at_rest,
            known,
            poses.numpy(),
            height=rows,
            width=columns,
            outputs=("bmode",),
            backend=backend,
            limits=limits,
        )
        return frames["bmode"].detach().cpu()

    search = _Search(frame, known, motions, rendered)
    poses = search.begin(_starts(first[0], motions, within_mm, within_deg))
    for stage in STAGES:
        poses = search.improve(poses, stage)
    found = search.result(poses[0], first[0])
    return replace(found, pose=scene.poses_as_tracked(found.pose[None])[0])


@dataclass(frozen=True, eq=False)
class _Fit:
    """How well poses fit at a stage."""

    poses: Tensor  # [K, 4, 4]
    left: Tensor  # [K, pixels], of the frame
    changes: Tensor  # [K, 6, pixels] per mm, of what is left by the six numbers
    corrections: Tensor  # [K], of the changes since they were taken

    @property
    def error(self) -> Tensor:  # [K]
        return self.left.square().mean(dim=1)

    def after(self, steps: Tensor, poses: Tensor, left: Tensor) -> tuple[Tensor, _Fit]:  # [K, 6] mm
        """Where steps led to something better, [K], and the fit at the better poses, its changes corrected."""
        missed = left - self.left - (steps[:, None] @ self.changes)[:, 0]
        along = steps / steps.square().sum(dim=1, keepdim=True).clamp(min=torch.finfo(torch.float64).tiny)
        better = left.square().mean(dim=1) < self.error
        return better, _Fit(
            torch.where(better[:, None, None], poses, self.poses),
            torch.where(better[:, None], left, self.left),
            self.changes + along[..., None] * missed[:, None],
            self.corrections + 1,
        )

    def replaced(self, which: Tensor, other: _Fit) -> _Fit:  # [K], of poses that the other has
        """The fit, some of whose poses have been taken anew."""
        parts = ((self.left, other.left), (self.changes, other.changes), (self.corrections, other.corrections))
        return _Fit(self.poses, *(old.index_put((which,), new) for old, new in parts))


class _Search:
    """One frame that is looked for."""

    def __init__(self, frame: Tensor, probe: Probe, motions: Motions, rendered: Rendered) -> None:
        self._frame, self._probe, self._motions, self._rendered = frame, probe, motions, rendered
        self._known: dict[tuple[bytes, int, int], Tensor] = {}  # frames by pose, rows and columns

    def begin(self, starts: Tensor) -> Tensor:  # [S, 4, 4] -> [K, 4, 4]
        """The starts that look most like the frame, the given one first among equals."""
        if len(starts) <= MOST_BEGUN:
            return starts
        scale, target = self._at(COARSE)
        left = self._left(starts, scale, target).square().mean(dim=1)
        return starts[left.argsort(stable=True)[:MOST_BEGUN]]

    def improve(self, poses: Tensor, stage: Stage) -> Tensor:  # [K, 4, 4] -> the best `kept`
        """Steps of Levenberg and Marquardt for all poses at once."""
        scale, target = self._at(stage)
        fit = self._linearised(poses, stage, scale, target)
        damping = torch.full((len(poses),), START_DAMPING, dtype=torch.float64)
        short_mm = stage.smoothing_mm * (SHORT_LAST_STEP if stage is LAST else SHORT_STEP)
        for _ in range(stage.steps):
            steps = _step(fit, damping)
            has_arrived = steps.norm(dim=1) < short_mm
            was_fresh = fit.corrections == 0
            if bool((has_arrived & was_fresh).all()):
                break
            tried = self._motions.moved(fit.poses, steps)
            better, fit = fit.after(steps, tried, self._left(tried, scale, target))
            is_misled = ~better & ~was_fresh
            damping = torch.where(better, damping / LESS_DAMPING, damping * torch.where(is_misled, 1.0, MORE_DAMPING))
            doubtful = is_misled | (has_arrived & ~was_fresh) | (better & (fit.corrections >= stage.corrected))
            if doubtful.any():
                fit = fit.replaced(doubtful, self._linearised(fit.poses[doubtful], stage, scale, target))
        return fit.poses[fit.error.argsort(stable=True)[: stage.kept]]

    def result(self, pose: Tensor, start: Tensor) -> Localization:
        """What is told of the best pose, by the last stage; how certain it is, by frames of all motions."""
        scale, target = self._at(LAST)
        fit = self._linearised(pose[None], LAST, scale, target, slides=False)
        similarity = _correlation(fit.left[0] + target.reshape(-1), target.reshape(-1))
        deviations = _deviations(fit.left[0].reshape(target.shape), fit.changes[0].reshape(6, *target.shape))
        shift_mm, turn_deg = self._motions.step_between(start, pose)
        return Localization(
            pose=pose.numpy(),
            similarity=similarity,
            is_found=similarity >= FOUND_SIMILARITY,
            position_std_mm=_three(deviations[:3]),
            angle_std_deg=_three(self._motions.degrees(deviations[3:])),
            shift_mm=shift_mm,
            turn_deg=turn_deg,
        )

    def _at(self, stage: Stage) -> tuple[Scale, Tensor]:
        """The scale of a stage, not finer than the frame, and what the frame looks like there."""
        rows, columns = min(stage.rows, self._frame.shape[0]), min(stage.columns, self._frame.shape[1])
        scale = Scale.of(self._probe, rows, columns, stage.smoothing_mm)
        return scale, scale.appearance(scale.resized(self._frame)[None])[0]

    def _left(self, poses: Tensor, scale: Scale, target: Tensor) -> Tensor:  # [K, 4, 4] -> [K, pixels]
        return _missed(self._frames(poses, scale.rows, scale.columns), scale, target)

    def _frames(self, poses: Tensor, rows: int, columns: int) -> Tensor:  # [K, 4, 4] -> [K, rows, columns]
        """The frames at poses, each of which is rendered once in a search."""
        keys = [(pose.numpy().tobytes(), rows, columns) for pose in poses]
        new = [index for index, key in enumerate(keys) if key not in self._known]
        if new:
            frames = self._rendered(poses[new], rows, columns)
            self._known.update({keys[index]: frame for index, frame in zip(new, frames, strict=True)})
        return torch.stack([self._known[key] for key in keys])

    def _linearised(self, poses: Tensor, stage: Stage, scale: Scale, target: Tensor, slides: bool = True) -> _Fit:
        """The fit at poses [K, 4, 4]; a frame that `slides` tells itself how motions within its plane change it."""
        count, size = len(poses), (scale.rows, scale.columns)
        motions, is_slid, places = _beside(self._probe, stage.probing_mm, *size)
        if not slides:
            is_slid = torch.zeros_like(is_slid)
        here = self._frames(poses, *size)
        rendered = poses[:, None] @ motions[~is_slid]
        frames = torch.empty(count, len(is_slid), *size)
        frames[:, ~is_slid] = self._frames(rendered.reshape(-1, 4, 4), *size).reshape(count, -1, *size)
        if slides:
            frames[:, is_slid] = slid(here, places)
        left = _missed(frames.reshape(-1, *size), scale, target).reshape(count, len(is_slid), -1)
        changes = (left[:, :6] - left[:, 6:]) / (2.0 * stage.probing_mm)
        return _Fit(poses, _missed(here, scale, target), changes, torch.zeros(count, dtype=torch.int64))


@lru_cache(maxsize=32)
def _beside(probe: Probe, step_mm: float, rows: int, columns: int) -> tuple[Tensor, Tensor, Tensor]:
    """The motions [12, 4, 4] of the central differences, for each of the six numbers a step forwards, then backwards.

    Then [12] whether a motion is within the image plane, and of those that are `places_after`.
    """
    ahead = step_mm * torch.eye(6, dtype=torch.float64)
    steps = torch.cat([ahead, -ahead])
    is_slid = steps[:, IN_PLANE].any(dim=1)
    motions = Motions.of(probe).of_steps(steps)
    return motions, is_slid, places_after(probe, motions[is_slid], rows, columns)


def _missed(frames: Tensor, scale: Scale, target: Tensor) -> Tensor:  # [C, rows, columns] -> [C, pixels]
    """What of the frame that is looked for frames do not explain."""
    return (scale.appearance(frames) - target).reshape(len(frames), -1).double()


def _step(fit: _Fit, damping: Tensor) -> Tensor:  # [K] -> [K, 6] mm
    """Downhill, damped by the curvature of each number, and not too far."""
    pixels = fit.left.shape[-1]
    slope = (fit.changes @ fit.left[..., None]) / pixels
    curvature = fit.changes @ fit.changes.mT / pixels  # Gauss and Newton's
    own = curvature.diagonal(dim1=1, dim2=2)
    floor = 1e-2 * own.mean(dim=1, keepdim=True) + torch.finfo(torch.float64).tiny
    damped = curvature + torch.diag_embed(damping[:, None] * (own + floor) + 1e-9 * floor)
    downhill: Tensor = -torch.linalg.lstsq(damped, slope).solution[..., 0]
    steps: Tensor = downhill * (LONGEST_STEP_MM / downhill.norm(dim=1, keepdim=True).clamp(min=LONGEST_STEP_MM))
    return steps


def _starts(start: Tensor, motions: Motions, within_mm: float, within_deg: float) -> Tensor:  # [4, 4] -> [S, 4, 4]
    """The start, and where it is less certain, others evenly about it."""
    wider = max(within_mm / NEAR_MM, within_deg / NEAR_DEG)
    if wider <= 1.0:
        return start[None]
    count = min(MOST_TRIED, round(8 * wider**2))
    even = SobolEngine(6, scramble=True, seed=SEED)  # type: ignore[no-untyped-call]
    spread = 2.0 * even.draw(count, dtype=torch.float64) - 1.0
    reach = torch.tensor([within_mm] * 3 + [float(np.radians(within_deg)) * motions.lever_mm] * 3, dtype=torch.float64)
    return torch.cat([start[None], motions.moved(start.expand(count, -1, -1), spread * reach)])


def _checked_image(image: Any) -> Tensor:  # [H, W] in [0, 1], float32
    array = np.asarray(image.detach().cpu() if isinstance(image, Tensor) else image)
    if array.ndim != 2 or array.dtype.kind not in "uf" or (array.dtype.kind == "u" and array.dtype != np.uint8):
        raise InvalidArgument(
            f"image must be grey values [H, W], uint8 or floating point, got {array.dtype} {list(array.shape)}",
            field="image",
        )
    check_image_size(*array.shape)
    if min(array.shape) < LEAST_PIXELS:
        raise InvalidArgument(
            f"image must have {LEAST_PIXELS} pixels a side or more, got {array.shape[0]}x{array.shape[1]}",
            field="image",
        )
    grey = array.astype(np.float32) / (255.0 if array.dtype == np.uint8 else 1.0)
    if not np.isfinite(grey).all() or grey.min() < 0.0 or grey.max() > 1.0:
        got = f"{array.dtype} from {grey.min():g} to {grey.max():g}"
        raise InvalidArgument(f"image must hold finite values in [0, 1], or uint8, got {got}", field="image")
    return torch.from_numpy(grey)


def _deviations(left: Tensor, changes: Tensor) -> Tensor:  # [H, W], [6, H, W] per mm -> [6] mm
    """The standard deviations of the six numbers at the best fit.

    What is left is alike in neighbouring pixels, and larger in some parts of the image than in others. So each block
    of the image counts as one observation of the slope: the covariance is A⁻¹ B A⁻¹, A the sum of products of changes
    and B that of the blocks' slopes (White 1980, clustered).
    """
    slopes = functional.adaptive_avg_pool2d(changes * left, BLOCKS) * (left.numel() / (BLOCKS[0] * BLOCKS[1]))
    slopes = slopes.reshape(6, -1)
    flat = changes.reshape(6, -1)
    inverse = torch.linalg.pinv(flat @ flat.mT, hermitian=True)
    variances: Tensor = (inverse @ (slopes @ slopes.mT) @ inverse).diagonal()
    return variances.clamp(min=0.0).sqrt()


def _correlation(one: Tensor, other: Tensor) -> float:
    one, other = one - one.mean(), other - other.mean()
    return float((one * other).sum() / (one.norm() * other.norm()).clamp(min=1e-12))


def _three(values: Tensor) -> tuple[float, float, float]:
    first, second, third = (float(value) for value in values)
    return first, second, third
