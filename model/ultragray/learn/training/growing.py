"""A scene that grows while its sweep arrives: Gaussians begin on each frame as it comes, and steps are taken on recent
frames and on all of them in turn.

New Gaussians lie between a new frame and its neighbours, as those of an informed start do (`initial`), so that a frame
shows something before the first step on it. What a whole sweep would tell (spacing, shadows, thickness of a slice) is
surveyed again whenever the frames have become half as many more. Every fifth frame from the third is held out, as it
will be of the finished data set (`sweep.split_sequence`), and judges each version, at its full size. Frames to train
from are made small, for steps that take little time: a scene of noisy frames gains most by seeing each of them often.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ultragray.errors import DatasetInvalid, TrainingDiverged
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.evaluation.metrics import frame_metrics
from ultragray.learn.evaluation.scoring import rendered_parts
from ultragray.learn.sweep import (
    HELD_OUT_START,
    HELD_OUT_STEP,
    ByteArray,
    Dataset,
    IntArray,
    Sweep,
    corner_distances_mm,
    in_recorded_order,
    spread_places,
)
from ultragray.learn.training.batch import Batch
from ultragray.learn.training.between import ViewsBetween, neighbours_of
from ultragray.learn.training.checkpointing import CheckpointHeader, read_checkpoint, write_checkpoint
from ultragray.learn.training.confidence import Examples, fit_weights
from ultragray.learn.training.config import TrainingConfig
from ultragray.learn.training.geometry import SAME_DETAIL, Geometry, Shadows, shared_detail
from ultragray.learn.training.initial import Start, initial_parameters
from ultragray.learn.training.intensity import least_sh0, project_sh0
from ultragray.learn.training.losses import SSIM_WINDOW
from ultragray.learn.training.memory import training_device
from ultragray.learn.training.optimizer import Optimizer, Schedule, is_trained
from ultragray.learn.training.poses import PoseRefinement
from ultragray.rendering.backends.inputs import spatial_order
from ultragray.rendering.backends.registry import choose_backend
from ultragray.rendering.frames import render
from ultragray.scene.confidence import ConfidenceModel, TrainingViews, predicted, terms_of
from ultragray.scene.gaussians import PARAMETERS, GaussianScene, no_smaller_than_held
from ultragray.scene.info import SceneInfo

PIXELS_PER_GAUSSIAN = 40  # fewer Gaussians than `fast` begins with: a step takes a third of the time, for 0.1 dB
LEAST_PIXELS, USUAL_GAUSSIANS = 8, 500  # of small frames: of so few pixels each, up to so many
LEAST_FRAMES = 4  # to train from, before anything is shown
SURVEY_GROWTH = 1.5
WINDOW_FRAMES = 6  # about each new one, among which it finds its neighbours
STILL = 0.25  # of the usual spacing: a frame nearer to one that is there already shows no new place
MOST_AT_ONCE, MOST_OF_DETAIL = 16_000, 38_000  # Gaussians of a sweep that is over and learned in seconds
DETAIL_BATCH, DETAIL_LINES = 4, 4  # views of a step where frames share their detail, and of them every fourth scan line
SMALL_PIXELS = 8_000  # of a frame to train from, at least
SIZED_BY = 16  # frames, which tell what becomes smaller
FOURS, FAR_LESS = ((2, 2), (1, 4), (4, 1)), 0.5  # rows and columns; of the variance that a square hides
RECENT_FRAMES, RECENT_STEPS = 16, 40  # of a new frame, every other is on recent ones; then all are on all frames
COARSE_STEPS = (60, 20)  # of Gaussians' first: on frames of half the size; of a quarter, which take a third of the time
COARSE_GAUSSIANS = 0.5  # of the pixels of a frame: with more of them, it is they that take the time
FLOOR_STEPS = 75  # of a Gaussian's first, in which what lies in a shadow keeps its floor
JUDGES, NEW_JUDGES = 12, 4  # held-out frames of a version, of those that judged the one before, and of all others
LEAST_CAUTION, REGAINED = 0.05, 1.1  # of the factor on all rates: its least, and what a version gives back of it
LOST_DB = 0.2  # a version that shows the frames before it worse by so much is not shown


class Judgement(NamedTuple):
    """The held-out frames that judged a version, by their place among all of them."""

    psnr_db: Mapping[int, float]
    ms_ssim: Mapping[int, float]

    @property
    def mean_psnr_db(self) -> float | None:
        return float(np.mean(list(self.psnr_db.values()))) if self.psnr_db else None


class GrowingTrainer:
    """The Gaussians of a sweep that is still being recorded, and what trains them."""

    def __init__(self, name: str, probe: Probe, *, seed: int = 0, device: str = "cpu", backend: str = "auto") -> None:
        self.name, self._probe, self._device_name, self._backend = name, probe, device, backend
        self._settings = TrainingConfig(seed=seed, refine_poses="none")
        self._device = training_device(device, backend)
        self._generator = torch.Generator().manual_seed(seed)
        self._train: Sweep | None = None
        self._held_out: Sweep | None = None  # at full size
        self._size: tuple[int, int] | None = None  # rows and columns of the frames to train from
        self.frame_count = self.step = 0
        self._grown = self._surveyed = 0  # training frames that Gaussians began on; that were there at the last survey
        self._parameters: dict[str, Tensor] = {}
        self._born, self._floor = torch.zeros(0, dtype=torch.int64), torch.zeros(0)  # [N]
        # PSNR of the version shown on the held-out frames that judged it; after a death perhaps on some that are still
        # to come again.
        self.judged: Mapping[int, float] = {}
        self._whole: PoseRefinement | None = None  # the poses of a sweep that came at once
        self._every = 1  # so-manyth scan line of a frame is in a step
        self._caution = 1.0  # factor on all rates: less after a version that was worse

    @property
    def is_growing(self) -> bool:
        """Whether there is anything to show."""
        return bool(self._parameters)

    @property
    def gaussian_count(self) -> int:
        return len(self._born)

    def add(self, images: ByteArray, poses: FloatArray) -> None:  # [F, H, W], [F, 4, 4] mm
        """Takes the next frames of the recording. Raises DatasetInvalid for such as a data set cannot have."""
        self._keep(images, poses)
        train = self._train
        if train is None or len(train) < LEAST_FRAMES:
            return
        if len(train) >= SURVEY_GROWTH * self._surveyed:
            self._survey(train)
        self._grow(train, np.arange(self._grown, len(train)))

    def take_step(self, rate: float = 1.0) -> float:
        """One step, its rates times `rate`, on recent frames or on all of them in turn; the loss."""
        assert self._train is not None
        train, config = self._train, self._config
        is_recent = self._whole is None and self.step % 2 == 0 and self.step - int(self._born.max()) < RECENT_STEPS
        first = max(0, len(train) - RECENT_FRAMES) if is_recent else 0
        assert config.views_between is not None
        between_count = round(config.views_between * config.batch_size)
        own_count = min(config.batch_size - between_count, len(train) - first)
        own = first + torch.randperm(len(train) - first, generator=self._generator)[:own_count]
        between = self._between[is_recent]
        batch = Batch.of(train, self._images, own, between, between_count, config, self._generator)
        shadowed, age = self._shadowed, self.step - int(self._born.max() if is_recent else self._born.median())
        if self._every > 1:
            first = int(torch.randint(self._every, (1,), generator=self._generator))
            batch, shadowed = batch.of_lines(self._probe.lines, first, self._every, shadowed)
        is_quick = self.gaussian_count <= COARSE_GAUSSIANS * train.height * train.width
        for steps in COARSE_STEPS:
            if age < steps and is_quick and batch.can_be_halved:
                batch, shadowed = batch.halved(shadowed)
        height, width = batch.truth.shape[1:]
        frames = render(
            self._view(),
            self._probe,
            batch.poses,
            height=height,
            width=width,
            outputs=("bmode", "transmittance"),
            backend=self._chosen_backend,
        )
        loss = batch.loss(frames, shadowed, config)
        loss.backward()  # type: ignore[no-untyped-call]
        with torch.no_grad():
            rates = self._schedule.rates(0)
            self._optimizer.step({name: self._caution * rate * one for name, one in rates.items()})
            floor = torch.where(self.step - self._born < FLOOR_STEPS, self._floor, 0.0)
            least = least_sh0(floor.to(self._device), config.intensity)
            project_sh0(self._parameters["sh0"], config.intensity, least)
        self.step += 1
        if not math.isfinite(value := float(loss.detach())):
            raise TrainingDiverged(f"training diverged in step {self.step}: the loss is {value}")
        return value

    def scene(self, judgement: Judgement) -> GaussianScene:
        """The scene as it is, on the CPU, with what is known of where it holds."""
        assert self._train is not None
        measured = {} if judgement.mean_psnr_db is None else {"psnr_db": judgement.mean_psnr_db}
        info = replace(
            self._info,
            gaussian_count=self.gaussian_count,
            training={**self._config.to_dict(), "step": self.step},
            metrics=measured,
            confidence=self._confidence(judgement),
            tissue_shares=None if self._whole is None else self._whole.tissue_shares,
        )
        splats = {name: tensor.detach().cpu().clone() for name, tensor in self._parameters.items()}
        poses = {"training_poses": self._train.poses} if self._whole is None else self._whole.of_scene()
        return GaussianScene.from_splats(no_smaller_than_held(splats), info=info, **poses)

    def judge(self) -> Judgement:
        """Measures the scene on some held-out frames that judged the version shown, and on some others."""
        held_out = self._held_out
        if held_out is None or not len(held_out):
            return Judgement({}, {})
        known = np.array(sorted(place for place in self.judged if place < len(held_out)), np.int64)
        others = np.setdiff1d(np.arange(len(held_out)), known)
        known, others = known[spread_places(len(known), JUDGES)], others[spread_places(len(others), NEW_JUDGES)]
        chosen = np.concatenate([known, others])
        psnr_db, ms_ssim = {}, {}
        parts = rendered_parts(self._view(), held_out.select(chosen), ("bmode",), self._chosen_backend)
        places = iter(chosen.tolist())
        with torch.no_grad():
            for some, frames in parts:
                truth = torch.from_numpy(some.images).float().div_(255.0)
                for metrics in frame_metrics(frames["bmode"].detach().float().cpu(), truth):
                    place = next(places)
                    psnr_db[place], ms_ssim[place] = metrics.psnr_db, metrics.ms_ssim
        return Judgement(psnr_db, ms_ssim)

    def is_worse(self, judgement: Judgement) -> bool:
        """Whether the version that is shown shows the same frames better by more than LOST_DB."""
        lost = [self.judged[place] - now for place, now in judgement.psnr_db.items() if place in self.judged]
        return bool(lost) and float(np.mean(lost)) > LOST_DB

    def accept(self, judgement: Judgement) -> None:
        """Counts the version of this judgement as the one that is shown."""
        self.judged = judgement.psnr_db
        self._caution = min(1.0, REGAINED * self._caution)

    def slow_down(self) -> None:
        """Goes on in smaller steps, until versions are shown again: too large ones show noise."""
        self._caution = max(LEAST_CAUTION, 0.5 * self._caution)

    def anew(self, dataset: Dataset) -> GrowingTrainer:
        """Another trainer of the same sweep, which is over: of all frames at once, at the poses of the path that they
        agree with.

        It has few Gaussians, so that it takes many steps in seconds, and no checkpoints. Where frames share their
        detail, small ones would hide it: then steps are on some of the scan lines, others each time.
        """
        whole = PoseRefinement.of(dataset, "path")
        other = GrowingTrainer(
            self.name, self._probe, seed=self._settings.seed, device=self._device_name, backend=self._backend
        )
        other._whole, other.judged = whole, self.judged
        train = whole.dataset.train
        lines, remainder = divmod(train.width, DETAIL_LINES)
        if not remainder and lines >= SSIM_WINDOW and shared_detail(train) >= SAME_DETAIL:
            other._size, other._every = (train.height, train.width), DETAIL_LINES
            other._settings = replace(other._settings, batch_size=DETAIL_BATCH, views_between=1 / DETAIL_BATCH)
        other.add(*in_recorded_order(whole.dataset))
        return other

    def save(self, path: Path) -> None:
        """Writes all that `restore` goes on from, beside the frames themselves."""
        state = {f"parameter.{name}": tensor for name, tensor in self._parameters.items()}
        state |= {f"adam.{name}": tensor for name, tensor in self._optimizer.tensors().items()}
        state |= {"born": self._born, "floor": self._floor}
        state |= {"frames": torch.tensor(self.frame_count), "centre_mm": torch.from_numpy(self._centre_mm)}
        state["generator"] = self._generator.get_state()
        count, steps = self.gaussian_count, max(1, self.step)
        config = replace(self._config, steps=steps, max_gaussians=count, initial_gaussians=count)
        write_checkpoint(path, CheckpointHeader(steps, 0.0, "", config), state)

    @staticmethod
    def frames_of(path: Path) -> int:
        """The number of frames that a checkpoint has grown from. Raises TrainingStateInvalid."""
        return int(read_checkpoint(path)[1]["frames"])

    def restore(self, path: Path, images: ByteArray, poses: FloatArray) -> None:
        """Goes on from a checkpoint, with the frames that it has grown from. Raises TrainingStateInvalid."""
        header, tensors = read_checkpoint(path)
        self._keep(images, poses)
        train = self._train
        assert train is not None
        self._centre_mm = tensors["centre_mm"].numpy()
        self.step = header.step
        self._born, self._floor = tensors["born"], tensors["floor"]
        self._survey(train)
        self._grown = len(train)
        self._parameters = self._trainable({name: tensors[f"parameter.{name}"] for name in PARAMETERS})
        self._begin_optimizer()
        self._optimizer.load({name.removeprefix("adam."): t for name, t in tensors.items() if name.startswith("adam.")})
        self._generator.set_state(tensors["generator"])
        self._look_between(train)

    def _keep(self, images: ByteArray, poses: FloatArray) -> None:
        """Sorts new frames into those to train from and those held out."""
        numbers = np.arange(self.frame_count, self.frame_count + len(images))
        is_held_out = numbers % HELD_OUT_STEP == HELD_OUT_START
        sweep = Sweep(images, poses, self._probe, numbers, self.name)
        if min(sweep.height, sweep.width) < SSIM_WINDOW:
            raise DatasetInvalid(f"{self.name}: images must have at least {SSIM_WINDOW} rows and columns")
        self._size = self._size or _small_size(images)
        self._train = _joined(self._train, _resized(sweep.select(np.flatnonzero(~is_held_out)), self._size))
        self._held_out = _joined(self._held_out, sweep.select(np.flatnonzero(is_held_out)))
        self.frame_count += len(images)

    def _survey(self, train: Sweep) -> None:
        """Looks at all frames for what the settings leave to the data, and for who lies beside whom."""
        assert self._held_out is not None
        geometry = Geometry.of(Dataset(self.name, train, train.select([])))
        if not self._surveyed and not self.step:
            self._centre_mm = geometry.centre_mm
        self._geometry = replace(geometry, centre_mm=self._centre_mm)
        self._config = self._settings.resolved(self._geometry)
        self._neighbours = neighbours_of(train).without_ends()
        self._follow_probe: bool | None = None  # found again with the views between
        self._shadows = Shadows(train)
        self._surveyed = len(train)
        self._shadowed = torch.zeros((0, train.height, train.width), dtype=torch.bool, device=self._device)
        self._images = torch.zeros((0, train.height, train.width), dtype=torch.uint8, device=self._device)
        self._schedule = Schedule(
            self._config, scene_scale_cm=self._geometry.scene_scale_cm, batch_size=self._config.batch_size
        )
        self._info = SceneInfo(
            centre_mm=self._centre_mm.tolist(),
            probe=self._probe,
            image_height=self._held_out.height,
            image_width=self._held_out.width,
            intensity=self._config.intensity,
            dataset_name=self.name,
            sh_degree=self._config.sh_degree,
        )

    def _grow(self, train: Sweep, new: IntArray) -> None:
        """Begins Gaussians between new frames and their neighbours, where these show a new place."""
        corners = train.corners_mm()
        distances = np.stack([corner_distances_mm(corners[place], corners) for place in new]) if len(new) else None
        if distances is not None:
            nearest = np.argsort(distances, axis=1)[:, : WINDOW_FRAMES + 1]
            window = np.unique(np.concatenate([new, nearest.ravel()]))
            beside = neighbours_of(train.select(window)).without_ends()
            is_new = np.isin(window[beside.pairs], new).any(axis=1)
            beside = replace(beside, pairs=beside.pairs[is_new], gaps_mm=beside.gaps_mm[is_new])
            self._join_neighbours(window[beside.pairs], beside.gaps_mm)
            for row, place in zip(distances, new, strict=True):
                row[place:] = np.inf  # of the frames before it
            moved = distances.min(axis=1) > STILL * self._neighbours.spacing_mm
            pixels = train.height * train.width
            usual = max(pixels // PIXELS_PER_GAUSSIAN, min(pixels // LEAST_PIXELS, USUAL_GAUSSIANS))
            count = int(moved.sum()) * usual
            if self._whole is not None:
                count = min(count, MOST_AT_ONCE if self._every == 1 else MOST_OF_DETAIL)
            if count and len(beside.pairs):
                config = replace(self._config, initial_gaussians=count, max_gaussians=count)
                part = Dataset(self.name, train.select(window), train.select([]))
                shadows = self._shadows.seen_in(part.train)
                start = partial(initial_parameters, part, beside, shadows, self._geometry, config, self._generator)
                self._append(start(by_detail=self._every > 1))
            self._grown = len(train)
        self._look_between(train)

    def _join_neighbours(self, pairs: IntArray, gaps_mm: FloatArray) -> None:
        known = self._neighbours
        is_new = ~(pairs[:, None] == known.pairs).all(axis=2).any(axis=1)
        joined = np.concatenate([known.pairs, pairs[is_new]]), np.concatenate([known.gaps_mm, gaps_mm[is_new]])
        self._neighbours = replace(known, pairs=joined[0], gaps_mm=joined[1])

    def _look_between(self, train: Sweep) -> None:
        """Views between frames: of all of them, and of recent ones."""
        seen = len(self._images)
        added = torch.tensor(train.images[seen:], device=self._device)
        self._images = torch.cat([self._images, added])
        shadows = self._shadows.seen_in(train.select(np.arange(seen, len(train))))
        self._shadowed = torch.cat([self._shadowed, torch.from_numpy(shadows.pixels()).to(self._device)])
        known = self._neighbours
        is_recent = known.pairs.max(axis=1) >= len(train) - RECENT_FRAMES
        recent = replace(known, pairs=known.pairs[is_recent], gaps_mm=known.gaps_mm[is_recent])
        everywhere = ViewsBetween(train, known, self._images, follow_probe=self._follow_probe)
        self._follow_probe = everywhere.follow_probe
        lately = everywhere
        if len(recent.pairs):
            lately = ViewsBetween(train, recent, self._images, follow_probe=self._follow_probe)
        self._between: Mapping[bool, ViewsBetween] = {False: everywhere, True: lately}

    def _append(self, start: Start) -> None:
        """Adds Gaussians, and puts all of them into spatial order again."""
        added = len(start.floor)
        old = {name: tensor.detach().cpu() for name, tensor in self._parameters.items()}
        joined = {name: torch.cat([old[name], one]) if old else one for name, one in start.parameters.items()}
        origin = torch.cat([torch.arange(self.gaussian_count), torch.full((added,), -1)])
        order = spatial_order(joined["means"])
        self._born = torch.cat([self._born, torch.full((added,), self.step)])[order]
        self._floor = torch.cat([self._floor, start.floor])[order]
        self._parameters = self._trainable({name: tensor[order].contiguous() for name, tensor in joined.items()})
        if old:
            self._optimizer.replace(self._parameters, origin[order].to(self._device), like_others=True)
        else:
            self._begin_optimizer()

    def _trainable(self, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {
            name: tensor.to(self._device).requires_grad_(is_trained(name, tensor.shape, self._config))
            for name, tensor in parameters.items()
        }

    def _begin_optimizer(self) -> None:
        self._optimizer = Optimizer(
            self._parameters, batch_size=self._config.batch_size, scale_penalty=self._config.scale_penalty
        )
        self._chosen_backend = choose_backend(self._backend, self._view())

    def _view(self) -> GaussianScene:
        """The parameters as a scene, without the checks of `from_splats`."""
        tensors: dict[str, Any] = {**self._parameters}
        return GaussianScene(**tensors, info=replace(self._info, gaussian_count=self.gaussian_count))

    def _confidence(self, judgement: Judgement) -> dict[str, object]:
        """Where the scene holds, by the frames that judged it: the model of `training.confidence` without hardness."""
        train, held_out = self._train, self._held_out
        if train is None or held_out is None or not judgement.ms_ssim:
            return {}
        places = sorted(judgement.ms_ssim)
        reached = np.array([judgement.ms_ssim[place] for place in places])
        some = held_out.select(places)
        measures = TrainingViews(train.poses, self._probe).measure(some.poses, self._probe)
        terms = terms_of(measures, np.zeros(len(train)))
        truth = torch.from_numpy(some.images[:1]).float().div_(255.0)
        black = max(0.0, frame_metrics(torch.zeros_like(truth), truth)[0].ms_ssim)
        weights = fit_weights(Examples(terms, reached), black)
        return ConfidenceModel(
            weights=tuple(weights.tolist()),
            black_ms_ssim=black,
            hardness=(0.0,) * len(train),
            fitted_on=len(places),
            error=float(np.abs(predicted(weights, terms, black) - reached).mean()),
            fitted_to_mm=float(measures.distance_mm.max()),
        ).to_dict()


def _small_size(images: ByteArray) -> tuple[int, int]:  # [F, H, W]
    """Rows and columns of frames of which four pixels become one, as often as that keeps SMALL_PIXELS and more: those
    of a square, or of one row or column where that hides far less. The lines of a fan lie closer than its beams are
    wide.
    """
    some = images[spread_places(len(images), SIZED_BY)].astype(np.float32)
    while some[0].size >= 4 * SMALL_PIXELS:
        count, height, width = some.shape
        candidates = []
        for rows, columns in FOURS:
            small = height // rows, width // columns
            if height % rows == width % columns == 0 and min(small) >= SSIM_WINDOW:
                fours = some.reshape(count, small[0], rows, small[1], columns)
                hidden = float(fours.var(axis=(2, 4)).mean()) / (1.0 if rows == columns else FAR_LESS)
                candidates.append((hidden, fours.mean(axis=(2, 4))))
        if not candidates:
            break
        some = min(candidates, key=lambda one: one[0])[1]
    return some.shape[1], some.shape[2]


def _resized(sweep: Sweep, size: tuple[int, int]) -> Sweep:
    """Its frames with fewer rows and columns, each pixel the mean of those in its place."""
    images = np.empty((len(sweep), *size), np.uint8)
    for image, small in zip(sweep.images, images, strict=True):
        small[:] = cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)
    return replace(sweep, images=images)


def _joined(before: Sweep | None, added: Sweep) -> Sweep:
    if before is None:
        return added
    return replace(
        before,
        images=np.concatenate([before.images, added.images]),
        poses=np.concatenate([before.poses, added.poses]),
        frame_numbers=np.concatenate([before.frame_numbers, added.frame_numbers]),
    )
