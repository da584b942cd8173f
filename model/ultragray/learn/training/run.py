"""The effort of a training, chosen on frames that are left out: more of it fits the frames better, not their gaps."""

from __future__ import annotations

import contextlib
import json
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch

from ultragray.errors import MemoryExceeded, TrainingDiverged, TrainingStateInvalid
from ultragray.files import write_whole
from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.sweep import Dataset
from ultragray.learn.synthesis.refinement import with_labels_of
from ultragray.learn.training.checkpointing import read_checkpoint_header
from ultragray.learn.training.confidence import LEAST_HELD_OUT, fit_confidence, held_out_frames, shorter, steps_of_fit
from ultragray.learn.training.config import USUAL_EFFORT, TrainingConfig
from ultragray.learn.training.progress import Progress, require_tensorboard
from ultragray.learn.training.speckle import fit_speckle
from ultragray.learn.training.trainer import CHECKPOINT_FILE, Trainer
from ultragray.scene.gaussians import GaussianScene

EFFORTS_FILE = "efforts.json"
OTHER_EFFORTS = ((2.0, 3.0), (0.5, 0.25))  # upwards, then downwards, as long as each is better than the one before

log = logging.getLogger(__name__)

TryOut: TypeAlias = Callable[[Dataset, TrainingConfig], FrameMetrics | None]


def choose_effort(dataset: Dataset, config: TrainingConfig, try_out: TryOut, folder: Path | None) -> float | None:
    """The effort that shows a part of the training frames best after a training on the others; 1 for too few frames.

    `try_out` trains and returns the mean metrics of the frames left out. Another effort than 1 must be better in each
    of them. None where `try_out` returns none: it was told to stop. `folder` keeps what was found: a choice that begins
    anew there has to try the rest only.
    """
    held_out = held_out_frames(dataset.train)
    if len(held_out) < LEAST_HELD_OUT:
        return USUAL_EFFORT
    kept = np.setdiff1d(np.arange(len(dataset.train)), held_out)
    part = Dataset(dataset.name, train=dataset.train.select(kept), val=dataset.train.select(held_out))
    trials = _Trials(dataset, config, folder)

    def measured(effort: float) -> FrameMetrics | None:
        metrics = trials.metrics.get(effort) or try_out(part, replace(config, effort=effort, confidence=False))
        if metrics is not None:
            trials.add(effort, metrics)
        return metrics

    chosen, best = USUAL_EFFORT, measured(USUAL_EFFORT)
    if best is None:
        return None
    for direction in OTHER_EFFORTS:
        for effort in direction if chosen == USUAL_EFFORT else ():
            try:
                metrics = measured(effort)
            except (MemoryExceeded, TrainingDiverged) as error:
                log.warning("effort %g cannot be tried: %s", effort, error)
                break
            if metrics is None:
                return None
            if not metrics.is_better_than(best):
                break
            chosen, best = effort, metrics
    log.info("effort %g shows the frames left out best: %.2f dB", chosen, best.psnr_db)
    return chosen


class _Trials:
    """What was found by effort; also in a file, where the run has a folder."""

    def __init__(self, dataset: Dataset, config: TrainingConfig, folder: Path | None) -> None:
        self.metrics: dict[float, FrameMetrics] = {}
        self._path = None if folder is None else folder / EFFORTS_FILE
        self._run = {"dataset_sha256": dataset.sha256, "config": config.to_dict()}
        if self._path is not None:
            with contextlib.suppress(OSError, ValueError, LookupError, TypeError):  # then it is tried again
                document = json.loads(self._path.read_text(encoding="utf-8"))
                if {name: document[name] for name in self._run} == self._run:
                    self.metrics = {float(effort): FrameMetrics(**of) for effort, of in document["metrics"].items()}

    def add(self, effort: float, metrics: FrameMetrics) -> None:
        self.metrics[effort] = metrics
        if self._path is None:
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        by_effort = {str(effort): metrics.to_dict() for effort, metrics in self.metrics.items()}
        write_whole(self._path, json.dumps({**self._run, "metrics": by_effort}, indent=2) + "\n")


FITTING = "fitting the confidence"

Report: TypeAlias = Callable[[Progress], None]


def train(
    dataset: Dataset,
    config: TrainingConfig | None = None,
    *,
    start: GaussianScene | None = None,
    folder: Path | None = None,
    resume: bool = False,
    report: Report | None = None,
    should_stop: Callable[[], bool] | None = None,
    device: str = "cpu",
    backend: str = "auto",
    checkpoint_interval_s: float = 30.0,
    tensorboard: bool = False,
) -> GaussianScene:
    """The scene trained from `dataset.train`, measured on `dataset.val` where that has frames.

    `start`: a scene to begin with, such as one made from labels, which keep theirs: a few frames then refine it.
    `device` is cpu, cuda or cuda:N; the backend `auto` is the one for it. The same dataset, configuration and machine
    give the same scene, bit for bit on one thread of a CPU; random choices are the same on every device. `folder` keeps
    checkpoints, the journal and the configuration; with `resume` the run goes on from its checkpoint and ends in the
    scene that an undisturbed run gives. `report` is called after every step. When `should_stop` turns true, the run
    ends after the step at hand with a checkpoint and the scene as it is; `scene.info.training["step"]` says how far
    it came. Where the configuration leaves the effort open, trainings on a part of the frames choose it before; stopped
    there, the scene has step 0, and the next `train` in the folder goes on with the choice. A finished run trains once
    more, shorter, to fit the scene's confidence (`config.confidence`); stopped there, the scene is whole but for that.
    The speckle of the frames is fitted before that, in seconds.
    Raises TrainingDiverged and MemoryExceeded (the last good checkpoint stays), TrainingStateInvalid, DatasetInvalid,
    BackendUnavailable, and InvalidArgument for a TensorBoard that is not installed; what can be known before the first
    step is, before `folder` is made.
    """
    if tensorboard:
        require_tensorboard()
    if folder is not None and not resume and (checkpoint := folder / CHECKPOINT_FILE).exists():
        raise TrainingStateInvalid(
            f"{checkpoint}: there is an unfinished run: resume it, or remove {folder} to begin anew"
        )
    apart = _Apart(report, should_stop, device, backend, start)
    settings = config or TrainingConfig()
    config = _with_effort(dataset, settings, folder, resume, apart)
    if config is None:
        return Trainer(dataset, settings, folder=None, device=device, backend=backend, start=start).scene()
    try:
        trainer = Trainer(dataset, config, folder=folder, device=device, backend=backend, start=start)
        if resume:
            trainer.restore()
    except torch.OutOfMemoryError as error:
        raise MemoryExceeded(
            f"the memory of {device} did not suffice for the Gaussians and the frames: lower max_gaussians",
            field="max_gaussians",
        ) from error
    with trainer.running_out_of_memory_explained():
        with trainer.logs(tensorboard) as log:
            trainer.run(log, _with_fit(report, dataset, trainer.config), should_stop, checkpoint_interval_s)
        scene, is_finished, resolved = trainer.scene(), trainer.is_finished, trainer.config
    if start is not None:
        scene = with_labels_of(start, scene, dataset.train)
    if is_finished:
        rest = scene.at_rest()
        refined = replace(dataset, train=replace(dataset.train, poses=rest.training_poses))
        speckle = fit_speckle(rest, refined.train, backend=backend)
        for one in (scene, rest):
            one.info = replace(one.info, speckle=speckle)
    if resolved.confidence and is_finished:
        del trainer  # what it takes of the memory is free for the second training
        settled = replace(resolved, refine_poses="none")
        scene.info.confidence.update(_fitted_confidence(refined, settled, apart))
    return scene


@dataclass(frozen=True)
class _Apart:
    """How the trainings beside the run are done, each on a part of its frames."""

    report: Report | None
    should_stop: Callable[[], bool] | None
    device: str
    backend: str
    start: GaussianScene | None

    def scene(self, part: Dataset, config: TrainingConfig, purpose: str) -> GaussianScene | None:
        """None where it was told to stop. `purpose`: for those who are told of the progress."""
        trainer = Trainer(part, config, folder=None, device=self.device, backend=self.backend, start=self.start)
        report = self.report

        def tell(progress: Progress) -> None:
            if report is not None:
                report(replace(progress, beside=purpose))

        with trainer.running_out_of_memory_explained():
            trainer.run(lambda line: None, tell, self.should_stop, math.inf)
        return trainer.scene() if trainer.is_finished else None


def _with_fit(report: Report | None, dataset: Dataset, config: TrainingConfig) -> Report | None:
    """The same, told of the time that fitting the scene's confidence takes after the run."""
    if report is None or not config.confidence:
        return report
    steps = steps_of_fit(config, dataset.train)

    def tell(progress: Progress) -> None:
        fit_s = steps / progress.steps_per_s if progress.steps_per_s else 0.0
        report(replace(progress, seconds_left=progress.seconds_left + fit_s))

    return tell


def _with_effort(
    dataset: Dataset, config: TrainingConfig, folder: Path | None, resume: bool, apart: _Apart
) -> TrainingConfig | None:
    """The configuration with its effort, chosen where it is open and matters; None where the choice was stopped."""
    if config.effort is not None or (config.steps is not None and config.max_gaussians is not None):
        return config
    if resume and folder is not None:
        return replace(config, effort=read_checkpoint_header(folder / CHECKPOINT_FILE).config.effort)

    def try_out(part: Dataset, settings: TrainingConfig) -> FrameMetrics | None:
        scene = apart.scene(part, settings, f"trying effort {settings.effort:g} on a part of the frames")
        return None if scene is None else FrameMetrics(**scene.info.metrics)

    effort = choose_effort(dataset, config, try_out, folder)
    return None if effort is None else replace(config, effort=effort)


def _fitted_confidence(dataset: Dataset, config: TrainingConfig, apart: _Apart) -> dict[str, Any]:
    """The scene's `confidence`; empty where the frames are too few or the second training came to nothing."""

    def train_part(part: Dataset) -> GaussianScene | None:
        scene = apart.scene(part, shorter(config, len(part.train) / len(dataset.train)), FITTING)
        return None if scene is None else scene.to(apart.device)

    try:
        model = fit_confidence(dataset, train_part, backend=apart.backend)
    except (MemoryExceeded, TrainingDiverged, torch.OutOfMemoryError) as error:
        logging.getLogger(__name__).warning("the scene gets no confidence: %s", error)
        return {}
    return {} if model is None else model.to_dict()


def scene_of_checkpoint(dataset: Dataset, folder: Path) -> GaussianScene:
    """The scene as it was at the last checkpoint of a run. Raises TrainingStateInvalid."""
    config = read_checkpoint_header(folder / CHECKPOINT_FILE).config
    trainer = Trainer(dataset, config, folder=folder, device="cpu", backend="auto")
    trainer.restore()
    return trainer.scene()
