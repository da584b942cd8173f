"""Where a frame was taken: near a start, from the frame before, anywhere, and together with other frames.

Frames are compared as `appearance` has it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from torch.quasirandom import SobolEngine

from ultragray.errors import InvalidArgument, InvalidPose
from ultragray.geometry.image_size import check_image_size
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import BoolArray, FloatArray, Probe
from ultragray.geometry.rotations import turns_of
from ultragray.geometry.scan_conversion import IntArray
from ultragray.learn.localization.appearance import Motions, PixelArray, Scale, displacements
from ultragray.learn.localization.settings import NEAR_DEG, NEAR_MM, Localization, LocalizationSettings, SearchKind
from ultragray.rendering.frames import render
from ultragray.rendering.limits import UNLIMITED, Limits
from ultragray.scene.gaussians import GaussianScene

# localize(): the pose at which a scene looks like a real frame, by Levenberg and Marquardt from coarse to fine.
#
# How each pixel A(x, z) changes with the pose comes from small frames on either side of it (on one side only they
# mislead). Motions within the image plane need none: the frame at the pose tells them by its own gradient, as a motion
# brings the tissue at p + d(p) to where p was, and so changes A by ∇A · d. The turns out of the plane move each pixel
# along elevation, too, by an amount that is its distance from the axis: where two frames beside the pose give ∂A/∂y,
# they need no frames of their own either. Shadows and thickness do not quite follow, so that tracking alone, which
# begins near the place, makes do with these two; a search renders six, and all twelve to say how certain its result is.
#
# The steps that follow bring one frame each, which corrects the changes along the step (Broyden 1965); they are taken
# anew where such a step fails or has arrived, and after a few: of coarse frames, where the place is far, after each. A
# backward pass would tell how one number changes, the sum of all squares; to get on with that alone takes many times as
# many steps.
#
# Fine structures hold a search fast at places a millimetre beside the right one. So it goes back to smoother frames
# once before it ends: from such a place they lead on.

Rendered = Callable[[Tensor, int, int], Tensor]  # [C, 4, 4], rows, columns -> [C, rows, columns] in [0, 1]

FOUND_SIMILARITY = 0.5
SEED = 0
BLOCKS = (4, 3)  # of the image, along depth and across, that err independently of each other
# By so much more frames err than the blocks tell, as the scene errs, too: 1.6 times in silico, and 3.6 times on
# ultranerf_liver, where errors of the tracker are among it.
SCENE_ERROR = 2.0
LEAST_PIXELS = 32  # of a side of a frame that can be found


ELEVATION = 1  # of the six numbers of a motion
OUT_OF_PLANE, ALL = (1, 3, 5), (0, 1, 2, 3, 4, 5)


@dataclass(frozen=True)
class Stage:
    """At most so many steps at one scale.

    `probing_mm` is how far the frames on either side are taken from a pose, `rendered` the numbers of a motion that
    they are taken for, and `corrected` how many steps may follow before they are taken anew.
    """

    rows: int
    columns: int
    smoothing_mm: float
    steps: int
    probing_mm: float
    corrected: int
    kept: int = 1  # of the poses that it begins with
    rendered: tuple[int, ...] = OUT_OF_PLANE


COARSE = Stage(64, 48, 3.0, 4, 1.0, 1, kept=2)
MIDDLE = Stage(64, 48, 1.5, 5, 0.6, 2)
FINE = Stage(128, 96, 0.8, 4, 0.3, 4)
LAST = Stage(128, 96, 0.5, 6, 0.2, 4)
STAGES = (COARSE, MIDDLE, FINE, MIDDLE, FINE, LAST)
TRACKING = (  # from the frame before, by a tenth of the frames
    Stage(96, 72, 1.0, 2, 0.3, 1, rendered=(ELEVATION,)),
    Stage(96, 72, 0.5, 3, 0.3, 4, rendered=(ELEVATION,)),
)
MOST_BEGUN = 6  # poses at the coarse stage
MOST_TRIED = 64  # poses that are looked at before, where the start is less certain
START_DAMPING, MORE_DAMPING, LESS_DAMPING = 1e-2, 6.0, 3.0
LONGEST_STEP_MM = 4.0
SHORT_STEP = 0.1  # of the smoothing: a stage whose steps are shorter has arrived
SHORT_LAST_STEP = 0.02  # likewise, of the last stage


def localize(
    scene: GaussianScene,
    image: Any,
    start: Any = None,
    *,
    probe: Probe | None = None,
    within_mm: float = NEAR_MM,
    within_deg: float = NEAR_DEG,
    search: SearchKind = SearchKind.NEAR,
    backend: str = "auto",
    limits: Limits = UNLIMITED,
) -> Localization:
    """The pose of a real frame [H, W] in a scene, from a start [4, 4] (mm, probe→scene) that is about right.

    `image` is grey values, an array or a tensor, uint8 or in [0, 1], in the layout of the scene's frames: rows along
    depth, columns across scan lines, not scan-converted. Its gain and contrast may differ from the scene's. `probe`
    took it (None: the one that the scene was trained with). The start may be off by `within_mm` and `within_deg`: more
    than 3 mm and 5° costs more time. `search` track goes on from the pose of the frame before, a millimetre or two
    away, in a tenth of the time; anywhere needs no start: an index of what the scene shows along its path is made for
    the first frame, and kept with the scene.
    Raises InvalidArgument for an image that is none or smaller than 32 pixels a side, InvalidPose, InvalidProbe, and
    what render() raises.
    """
    frame = _checked_image(image)
    settings = LocalizationSettings(within_mm=within_mm, within_deg=within_deg, search=search)
    known = scene.info.probe_or(probe)
    motions, rendered = Motions.of(known), _renderer(scene, known, backend, limits)
    looked = _Search(frame, known, motions, rendered)
    if settings.search is SearchKind.ANYWHERE:
        index = scene.prepared(f"places of {known!r}", lambda: Places.of(scene, known, motions, rendered))
        starts = first = index.nearest(frame)
        poses = looked.begin(starts)
    else:
        first = torch.from_numpy(scene.poses_at_rest(_one_start(start)))
        poses = (
            first
            if settings.search is SearchKind.TRACK
            else looked.begin(_starts(first[0], motions, within_mm, within_deg))
        )
    stages = TRACKING if settings.search is SearchKind.TRACK else STAGES
    for stage in stages:
        fit = looked.improve(poses, stage)
        poses = fit.poses
    result = looked.result(fit, first[0], stages[-1])
    return replace(result, pose=scene.poses_as_tracked(result.pose[None])[0])


def _renderer(scene: GaussianScene, probe: Probe, backend: str, limits: Limits) -> Rendered:
    """Frames of the tissue at rest."""
    at_rest = scene.at_rest()

    def rendered(poses: Tensor, rows: int, columns: int) -> Tensor:
        frames = render(
            at_rest,
            probe,
            poses.numpy(),
            height=rows,
            width=columns,
            outputs=("bmode",),
            backend=backend,
            limits=limits,
        )
        return frames["bmode"].detach().cpu()

    return rendered


def _one_start(start: Any) -> FloatArray:  # [1, 4, 4]
    if start is None:
        raise InvalidPose("start is required, unless a frame is looked for anywhere", field="start")
    poses = check_poses(start, field="start")
    if len(poses) != 1:
        raise InvalidArgument(f"start must be one pose, got {len(poses)}", field="start")
    return poses


class Tracker:
    """Where each frame of a probe in motion was taken, from that of the frame before."""

    def __init__(self, scene: GaussianScene, start: Any = None, *, probe: Probe | None = None) -> None:
        """`start` [4, 4]: about where the first frame is taken, mm; None: anywhere. Raises InvalidPose."""
        self._scene, self._probe = scene, probe
        self._last = None if start is None else _one_start(start)[0]
        self._motion: FloatArray | None = None  # [4, 4], from frame to frame; None: not known
        self._is_lost = False  # the frame before was not found

    def locate(self, image: Any) -> Localization:  # [H, W]
        """The pose of the next frame, looked for where the motion of the last two leads, and about the last one where
        it is not found there; anywhere where it is not found there either. After frames that were not found it is
        looked for both about the last one and anywhere, for the better of the two. Raises what localize() raises.
        """
        results = []
        if self._last is not None and self._motion is not None:
            results.append(self._localized(image, self._last @ self._motion, SearchKind.TRACK))
        if self._last is not None and not any(one.is_found for one in results):
            results.append(self._localized(image, self._last, SearchKind.NEAR))
        if self._is_lost or not any(one.is_found for one in results):
            results.append(self._localized(image, None, SearchKind.ANYWHERE))
        best = max(results, key=lambda one: (one.is_found, one.similarity))
        if best.is_found:
            before = best.pose if self._last is None or self._is_lost else self._last
            self._motion, self._last = np.linalg.inv(before) @ best.pose, best.pose
        else:
            self._motion = None
        self._is_lost = not best.is_found
        return best

    def _localized(self, image: Any, start: FloatArray | None, search: SearchKind) -> Localization:
        return localize(self._scene, image, start, probe=self._probe, search=search)


# move_together(): one motion of all poses, by all their frames at once.
#
# Each frame tells its residuals r and their changes by the six numbers of its own motion, C. A small motion ξ of all
# poses, about a point in their midst, is the motion J ξ of each, with J by the probe's axes: so A = Σ Jᵀ Cᵀ C J and
# b = Σ Jᵀ Cᵀ r, and ξ = −A⁻¹ b. Directions that one frame cannot tell, as along a vessel, another does.

TOGETHER = (MIDDLE, FINE, LAST)
ROUNDS = 3  # of each stage


def move_together(
    scene: GaussianScene, images: Sequence[Any], poses: FloatArray, *, probe: Probe | None = None, backend: str = "auto"
) -> FloatArray:  # [N, 4, 4] mm, in the frame of the sweep -> [4, 4]
    """The rigid motion of all poses, applied from the left, after which the scene looks most like all the images.

    Raises what localize() raises.
    """
    known = scene.info.probe_or(probe)
    motions, rendered = Motions.of(known), _renderer(scene, known, backend, UNLIMITED)
    searches = [_Search(_checked_image(image), known, motions, rendered) for image in images]
    first = torch.from_numpy(poses)
    middle = (first[:, :3, :3] @ motions.middle_mm + first[:, :3, 3]).mean(dim=0)
    about = Motions(middle, motions.lever_mm)
    whole = torch.eye(4, dtype=torch.float64)
    for stage in TOGETHER:
        trials = []
        for _ in range(ROUNDS):
            placed = whole @ first
            at_rest = torch.from_numpy(scene.poses_at_rest(placed.numpy()))
            fits = [one.linearised(pose[None], stage) for one, pose in zip(searches, at_rest, strict=True)]
            residuals = np.concatenate([fit.residuals[0] for fit in fits])
            trials.append((float(np.square(residuals).mean()), whole))
            jacobians = (_jacobian(about, motions, pose).numpy() for pose in placed)
            changes = np.concatenate([own.T @ fit.changes[0] for own, fit in zip(jacobians, fits, strict=True)], axis=1)
            joint = _Fit(whole[None], residuals[None], changes[None], np.zeros(1, np.int64))
            whole = about.of_steps(torch.from_numpy(_step(joint, np.array([START_DAMPING]))))[0] @ whole
        whole = min(trials, key=lambda one: one[0])[1]
    return np.asarray(whole.numpy())


def _jacobian(about: Motions, motions: Motions, pose: Tensor) -> Tensor:  # [4, 4] -> [6, 6]
    """By the numbers of a small motion of a pose from the left, about a point of the scene, its own numbers."""
    small = 1e-4 * torch.eye(6, dtype=torch.float64)
    own = torch.linalg.inv(pose) @ about.of_steps(small) @ pose
    turns = torch.from_numpy(turns_of(own[:, :3, :3].numpy()))
    shifts = own[:, :3, 3] + own[:, :3, :3] @ motions.middle_mm - motions.middle_mm
    return torch.cat([shifts, turns * motions.lever_mm], dim=1).T / 1e-4


# Places: what a scene shows along the path of its sweep and around it, to find a frame of which nothing is known.
#
# Small frames are rendered at poses evenly around the training views, and described by their structures at the coarse
# stage, of length 1: the scalar product with that of a frame is their correlation. The places that correlate best, not
# too near to each other, are where the search begins.

PATH_MM = 4.0  # between the views that places are around
AROUND = 24  # places around each
AROUND_MM, AROUND_DEG = (6.0, 2.0, 2.0), 10.0  # along lateral, elevation and axial axis
MOST_PLACES = 4800
DESCRIBED = Stage(32, 24, 3.0, 0, 1.0, 0)
APART_MM, APART_DEG = 2.0, 4.0
MOST_NEAREST = 32


@dataclass(frozen=True, eq=False)
class Places:
    """Poses around the training views of a scene, and what it shows there to one probe."""

    probe: Probe
    motions: Motions
    poses: Tensor  # [P, 4, 4], in tissue at rest
    descriptors: Tensor  # [P, D], of length 1

    @classmethod
    def of(cls, scene: GaussianScene, probe: Probe, motions: Motions, rendered: Rendered) -> Places:
        """Raises InvalidArgument where the scene holds no training poses."""
        views = torch.from_numpy(scene.poses_at_rest(scene.training_poses))
        if not len(views):
            raise InvalidArgument(
                "a frame is looked for along the sweep, and the scene holds no training poses", field="start"
            )
        along = [0]
        for number in range(1, len(views)):
            shift_mm, turn_deg = motions.step_between(views[along[-1]], views[number])
            if shift_mm + 0.4 * turn_deg >= PATH_MM:
                along.append(number)
        chosen = views[along[:: max(1, math.ceil(len(along) * AROUND / MOST_PLACES))]]
        even = SobolEngine(6, scramble=True, seed=SEED)  # type: ignore[no-untyped-call]
        spread = 2.0 * even.draw(len(chosen) * AROUND, dtype=torch.float64) - 1.0
        reach = torch.tensor([*AROUND_MM, *[math.radians(AROUND_DEG) * motions.lever_mm] * 3], dtype=torch.float64)
        poses = motions.moved(chosen.repeat_interleave(AROUND, 0), spread * reach)
        poses[::AROUND] = chosen
        scale = Scale.of(probe, DESCRIBED.rows, DESCRIBED.columns, DESCRIBED.smoothing_mm)
        parts = (rendered(part, scale.rows, scale.columns) for part in torch.split(poses, AROUND))
        return cls(probe, motions, poses, torch.cat([_descriptors(scale, frames) for frames in parts]))

    def nearest(self, frame: Tensor) -> Tensor:  # [H, W] -> [K, 4, 4]
        """The poses whose frames look most like a frame, best first."""
        scale = Scale.of(self.probe, DESCRIBED.rows, DESCRIBED.columns, DESCRIBED.smoothing_mm)
        order = (self.descriptors @ _descriptors(scale, scale.resized(frame)[None])[0]).argsort(descending=True)
        chosen: list[Tensor] = []
        for pose in self.poses[order[: 4 * MOST_NEAREST]]:
            apart = (self.motions.step_between(pose, other) for other in chosen)
            if all(shift_mm > APART_MM or turn_deg > APART_DEG for shift_mm, turn_deg in apart):
                chosen.append(pose)
        return torch.stack(chosen[:MOST_NEAREST])


def _descriptors(scale: Scale, frames: Tensor) -> Tensor:  # [C, rows, columns] -> [C, D]
    structures = torch.from_numpy(scale.appearance(frames)).flatten(1)
    centred = structures - structures.mean(dim=1, keepdim=True)
    return functional.normalize(centred, dim=1)


@dataclass(frozen=True, eq=False)
class _Fit:
    """How well poses fit at a stage.

    What has a value for each pixel is NumPy's, on one thread: torch's wait for each other, on a busy machine many times
    as long as the sums take.
    """

    poses: Tensor  # [K, 4, 4]
    residuals: FloatArray  # [K, pixels], of the frame
    changes: FloatArray  # [K, 6, pixels] per mm, of the residuals by the six numbers
    corrections: IntArray  # [K], of the changes since they were taken

    @property
    def error(self) -> FloatArray:  # [K]
        error: FloatArray = np.square(self.residuals).mean(axis=1)
        return error

    def after(self, steps: FloatArray, poses: Tensor, residuals: FloatArray) -> tuple[BoolArray, _Fit]:  # [K, 6] mm
        """Where steps led to something better, [K], and the fit at the better poses, its changes corrected."""
        missed = residuals - self.residuals - (steps[:, None] @ self.changes)[:, 0]
        along = steps / np.square(steps).sum(axis=1, keepdims=True).clip(min=np.finfo(np.float64).tiny)
        better = np.square(residuals).mean(axis=1) < self.error
        return better, _Fit(
            torch.where(torch.from_numpy(better)[:, None, None], poses, self.poses),
            np.where(better[:, None], residuals, self.residuals),
            self.changes + along[..., None] * missed[:, None],
            self.corrections + 1,
        )

    def best(self, count: int) -> _Fit:
        """The fit at the poses that fit best, the first of equals first."""
        which = self.error.argsort(kind="stable")[:count]
        return _Fit(self.poses[which], self.residuals[which], self.changes[which], self.corrections[which])

    def replaced(self, which: BoolArray, other: _Fit) -> _Fit:  # [K], of poses that the other has
        """The fit, some of whose poses have been taken anew."""
        residuals, changes, corrections = self.residuals.copy(), self.changes.copy(), self.corrections.copy()
        residuals[which], changes[which], corrections[which] = other.residuals, other.changes, other.corrections
        return _Fit(self.poses, residuals, changes, corrections)


class _Search:
    """One frame that is looked for."""

    def __init__(self, frame: Tensor, probe: Probe, motions: Motions, rendered: Rendered) -> None:
        self._frame, self._probe, self._motions, self._rendered = frame, probe, motions, rendered
        self._known: dict[tuple[bytes, int, int], Tensor] = {}  # frames by pose, rows and columns
        self._targets: dict[Stage, tuple[Scale, PixelArray]] = {}

    def begin(self, starts: Tensor) -> Tensor:  # [S, 4, 4] -> [K, 4, 4]
        """The starts that look most like the frame, the given one first among equals."""
        if len(starts) <= MOST_BEGUN:
            return starts
        scale, target = self._at(COARSE)
        error = np.square(self._residuals(starts, scale, target)).mean(axis=1)
        return starts[error.argsort(kind="stable")[:MOST_BEGUN]]

    def improve(self, poses: Tensor, stage: Stage) -> _Fit:  # [K, 4, 4] -> of the best `kept`
        """Steps of Levenberg and Marquardt for all poses at once."""
        scale, target = self._at(stage)
        fit = self._linearised(poses, stage, scale, target)
        damping = np.full(len(poses), START_DAMPING)
        short_mm = stage.smoothing_mm * (SHORT_LAST_STEP if stage is LAST else SHORT_STEP)
        for rest in reversed(range(stage.steps)):
            steps = _step(fit, damping)
            has_arrived = np.linalg.norm(steps, axis=1) < short_mm
            was_fresh = fit.corrections == 0
            if (has_arrived & was_fresh).all():
                break
            new_poses = self._motions.moved(fit.poses, torch.from_numpy(steps))
            better, fit = fit.after(steps, new_poses, self._residuals(new_poses, scale, target))
            is_misled = ~better & ~was_fresh
            damping = np.where(better, damping / LESS_DAMPING, damping * np.where(is_misled, 1.0, MORE_DAMPING))
            doubtful = is_misled | (has_arrived & ~was_fresh) | (better & (fit.corrections >= stage.corrected))
            if rest and doubtful.any():
                fit = fit.replaced(doubtful, self._linearised(fit.poses[doubtful], stage, scale, target))
        return fit.best(stage.kept)

    def result(self, fit: _Fit, start: Tensor, stage: Stage) -> Localization:
        """The result at the best pose of the last stage: of a search by all numbers, of a track by its last step."""
        (scale, target), pose = self._at(stage), fit.poses[0]
        if stage is LAST:
            fit = self._linearised(pose[None], stage, scale, target, ALL)
        sought = _flat(target)
        similarity = _correlation(fit.residuals[0] + sought, sought)
        residuals, changes = fit.residuals[0].reshape(target.shape), fit.changes[0].reshape(6, *target.shape)
        deviations = torch.from_numpy(_deviations(residuals, changes))
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

    def _at(self, stage: Stage) -> tuple[Scale, PixelArray]:
        """The scale of a stage, not finer than the frame, and what the frame looks like there."""
        if stage not in self._targets:
            rows, columns = min(stage.rows, self._frame.shape[0]), min(stage.columns, self._frame.shape[1])
            scale = Scale.of(self._probe, rows, columns, stage.smoothing_mm)
            self._targets[stage] = scale, scale.appearance(scale.resized(self._frame)[None])[0]
        return self._targets[stage]

    def _residuals(self, poses: Tensor, scale: Scale, target: PixelArray) -> FloatArray:  # [K, 4, 4] -> [K, pixels]
        return _missed(self._frames(poses, scale.rows, scale.columns), scale, target)

    def _frames(self, poses: Tensor, rows: int, columns: int) -> Tensor:  # [K, 4, 4] -> [K, rows, columns]
        """The frames at poses, each of which is rendered once in a search."""
        keys = [(pose.numpy().tobytes(), rows, columns) for pose in poses]
        new = [index for index, key in enumerate(keys) if key not in self._known]
        if new:
            frames = self._rendered(poses[new], rows, columns)
            self._known.update({keys[index]: frame for index, frame in zip(new, frames, strict=True)})
        return torch.stack([self._known[key] for key in keys])

    def linearised(self, poses: Tensor, stage: Stage) -> _Fit:  # [K, 4, 4]
        return self._linearised(poses, stage, *self._at(stage))

    def _linearised(
        self, poses: Tensor, stage: Stage, scale: Scale, target: PixelArray, rendered: tuple[int, ...] | None = None
    ) -> _Fit:
        """The fit at poses [K, 4, 4], and its changes, by frames on either side for the numbers that are `rendered`."""
        size, numbers = (scale.rows, scale.columns), list(stage.rendered if rendered is None else rendered)
        motions = _beside(self._probe, stage.probing_mm)[:, numbers]
        every = torch.cat([poses, (poses[:, None, None] @ motions).reshape(-1, 4, 4)])
        seen = scale.appearance(self._frames(every, *size))
        here, after = seen[: len(poses)], seen[len(poses) :].reshape(len(poses), 2, -1, *size)
        differences = (after[:, 0] - after[:, 1]) / (2.0 * stage.probing_mm)
        moves = displacements(self._probe, *size).numpy()
        by_row, by_column = (np.asarray(np.gradient(here, axis=axis)) for axis in (1, 2))
        by_elevation = differences[:, numbers.index(ELEVATION)]
        changes = by_row[:, None] * moves[:, 0] + by_column[:, None] * moves[:, 1] + by_elevation[:, None] * moves[:, 2]
        changes[:, numbers] = differences
        return _Fit(poses, _flat(here - target), _flat(changes), np.zeros(len(poses), np.int64))


@lru_cache(maxsize=32)
def _beside(probe: Probe, step_mm: float) -> Tensor:  # [2, 6, 4, 4]
    """The motions of the central differences: for each of the six numbers a step forwards, then backwards."""
    ahead = step_mm * torch.eye(6, dtype=torch.float64)
    return Motions.of(probe).of_steps(torch.stack([ahead, -ahead]))


def _missed(frames: Tensor, scale: Scale, target: PixelArray) -> FloatArray:  # [C, rows, columns] -> [C, pixels]
    """What of the frame that is looked for frames do not explain."""
    return _flat(scale.appearance(frames) - target)


def _flat(images: PixelArray) -> FloatArray:  # [..., rows, columns] -> [..., pixels]
    return images.reshape(*images.shape[:-2], -1).astype(np.float64)


def _step(fit: _Fit, damping: FloatArray) -> FloatArray:  # [K] -> [K, 6] mm
    """Downhill, damped by the curvature of each number, and not too far."""
    pixels = fit.residuals.shape[-1]
    slope = (fit.changes @ fit.residuals[..., None]) / pixels
    curvature = fit.changes @ fit.changes.swapaxes(1, 2) / pixels  # Gauss and Newton's
    own = curvature.diagonal(axis1=1, axis2=2)
    # Where nothing changes, as in a black frame, epsilon gives the matrix an inverse.
    floor = 1e-2 * own.mean(axis=1, keepdims=True) + np.finfo(np.float64).eps
    damped = curvature + (damping[:, None] * (own + floor) + 1e-9 * floor)[..., None] * np.eye(own.shape[1])
    downhill = -np.linalg.solve(damped, slope)[..., 0]  # not by torch, whose sums differ from call to call
    lengths = np.linalg.norm(downhill, axis=1, keepdims=True)
    steps: FloatArray = downhill * (LONGEST_STEP_MM / np.maximum(lengths, LONGEST_STEP_MM))
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
        description = f"{array.dtype} from {grey.min():g} to {grey.max():g}"
        raise InvalidArgument(f"image must hold finite values in [0, 1], or uint8, got {description}", field="image")
    return torch.from_numpy(grey)


def _deviations(residuals: FloatArray, changes: FloatArray) -> FloatArray:  # [H, W], [6, H, W] per mm -> [6] mm
    """The standard deviations of the six numbers at the best fit.

    Residuals are alike in neighbouring pixels, and larger in some parts of the image than in others. So the image is
    cut into blocks, and the fit repeated without each of them in turn: what these fits scatter by, times K − 1, is the
    variance (the jackknife, of clusters). It misses what errs alike in all blocks, as SCENE_ERROR has it.
    """
    rows, columns = (np.arange(count + 1) * side // count for side, count in zip(residuals.shape, BLOCKS, strict=True))
    blocks = [np.s_[..., top:bottom, left:right] for top, bottom in pairwise(rows) for left, right in pairwise(columns)]
    pixels = [(changes[block].reshape(6, -1), residuals[block].ravel()) for block in blocks]
    curvatures = np.stack([own @ own.T for own, _ in pixels])
    slopes = np.stack([own @ residual for own, residual in pixels])
    inverses = np.linalg.pinv(curvatures.sum(axis=0) - curvatures, hermitian=True)
    fits = (inverses @ (slopes.sum(axis=0) - slopes)[..., None])[..., 0]  # [K, 6]
    deviations: FloatArray = SCENE_ERROR * math.sqrt(len(blocks) - 1) * fits.std(axis=0)
    return deviations


def _correlation(one: FloatArray, other: FloatArray) -> float:
    one, other = one - one.mean(), other - other.mean()
    return float((one * other).sum() / max(np.linalg.norm(one) * np.linalg.norm(other), 1e-12))


def _three(values: Tensor) -> tuple[float, float, float]:
    first, second, third = (float(value) for value in values)
    return first, second, third
