"""train(): a dataset becomes a scene."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from ..datasets.sweep import Dataset
from ..errors import MemoryExceeded, TrainingDiverged
from ..scene import GaussianScene
from .board import require_tensorboard
from .checkpointing import read_checkpoint_header
from .confidence.calibration import fit_confidence, shorter
from .config import TrainingConfig
from .progress import Progress
from .trainer import CHECKPOINT_FILE, Trainer


def train(
    dataset: Dataset,
    config: TrainingConfig | None = None,
    *,
    folder: Path | None = None,
    resume: bool = False,
    report: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    device: str = "cpu",
    backend: str = "auto",
    checkpoint_interval_s: float = 30.0,
    tensorboard: bool = False,
) -> GaussianScene:
    """The scene trained from `dataset.train`, measured on `dataset.val` where that has frames.

    `device` is cpu, cuda or cuda:N; the backend `auto` is the one for it. The same dataset, configuration and machine
    give the same scene, bit for bit on one thread of a CPU; random choices are the same on every device. `folder` keeps
    checkpoints, the journal and the configuration; with `resume` the run goes on from its checkpoint and ends in the
    scene that an undisturbed run gives. `report` is called after every step. When `should_stop` turns true, the run
    ends after the step at hand with a checkpoint and the scene as it is; `scene.info.training["step"]` says how far
    it came. A finished run then trains once more, shorter, to fit the scene's confidence (`config.confidence`); stopped
    there, the scene is whole but for that.
    Raises TrainingDiverged and MemoryExceeded (the last good checkpoint stays), TrainingStateInvalid, DatasetInvalid,
    BackendUnavailable, and InvalidArgument for a TensorBoard that is not installed; what can be known before the first
    step is, before `folder` is made.
    """
    if tensorboard:
        require_tensorboard()
    try:
        trainer = Trainer(dataset, config or TrainingConfig(), folder=folder, device=device, backend=backend)
        if resume:
            trainer.restore()
    except torch.OutOfMemoryError as error:
        raise MemoryExceeded(
            f"the memory of {device} did not suffice for the Gaussians and the frames: lower max_gaussians",
            field="max_gaussians",
        ) from error
    with trainer.running_out_of_memory_explained():
        with trainer.logs(tensorboard) as log:
            trainer.run(log, report, should_stop, checkpoint_interval_s)
        scene, is_finished, resolved = trainer.scene(), trainer.is_finished, trainer.config
    if resolved.confidence and is_finished:
        del trainer  # what it takes of the memory is free for the second training
        refined = replace(dataset, train=replace(dataset.train, poses=scene.training_poses))
        settled = replace(resolved, refine_poses="none")
        scene.info.confidence.update(_fitted_confidence(refined, settled, should_stop, device, backend))
    return scene


def _fitted_confidence(
    dataset: Dataset, config: TrainingConfig, should_stop: Callable[[], bool] | None, device: str, backend: str
) -> dict[str, Any]:
    """The scene's `confidence`; empty where the frames are too few or the second training came to nothing."""

    def train_part(part: Dataset) -> GaussianScene | None:
        fewer = shorter(config, len(part.train) / len(dataset.train))
        trainer = Trainer(part, fewer, folder=None, device=device, backend=backend)
        while not trainer.is_finished:
            if should_stop is not None and should_stop():
                return None
            trainer.take_step()
        return trainer.scene().to(device)

    try:
        model = fit_confidence(dataset, train_part, backend=backend)
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
