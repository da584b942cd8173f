"""The work of a training job: a dataset becomes a scene, its metrics, its curve and a few pictures."""

from __future__ import annotations

import fcntl
import json
import math
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.datasets.sweep import Dataset
from ultragray.errors import TrainingStateInvalid
from ultragray.evaluation import evaluate
from ultragray.scene import GaussianScene
from ultragray.side_by_side import write_side_by_side
from ultragray.training import Progress as TrainingProgress
from ultragray.training import TrainingConfig
from ultragray.training import train as train_scene
from ultragray.training.trainer import CHECKPOINT_FILE, CONFIG_FILE, JOURNAL_FILE

from ..dataset_store import DatasetStore
from ..scenes import SUFFIX
from .curve import draw_training_curve
from .folder import JobFolder, Outcome, Progress
from .specification import TrainJob
from .work import Stopped, Work

CHECKPOINT_INTERVAL_S = 10.0
PICTURES = 4  # held-out frames, evenly spread
_LINES = 20  # of the log in a run


def train(work: Work, job: TrainJob) -> Outcome:
    """Trains, or goes on from the checkpoint that an earlier process left, and completes the artifacts.

    Raises Stopped, DatasetNotFound, DatasetInvalid, InvalidArgument, and what `ultragray.training.train` raises.
    """
    torch.set_num_threads(work.request.threads)
    source, options = DatasetStore(work.folder.artifact_folder).source(job.dataset)
    config = TrainingConfig.preset(job.preset, **job.settings)
    device = chosen_device(job.device, work.request.device)
    dataset = replace(load_dataset(source, SourceOptions(**options)), name=job.dataset)
    _take_over_run(work)
    checkpoint = work.folder.run / CHECKPOINT_FILE
    resume = checkpoint.exists()
    sys.stderr.write(
        f"training {job.scene} from {job.dataset} on {device}, {work.request.threads} threads"
        f"{', going on from a checkpoint' if resume else ''}\n"
    )
    scene = train_scene(
        dataset,
        config,
        folder=work.folder.run,
        resume=resume,
        report=lambda state: _report(work, state),
        should_stop=work.should_stop,
        device=device,
        checkpoint_interval_s=CHECKPOINT_INTERVAL_S,
    )
    if scene.info.training["step"] < scene.info.training["steps"]:
        raise Stopped
    return _finish(work, job, dataset, scene, device)


def chosen_device(asked: str, workers: str) -> str:
    """The device of a job: its own wish, else its worker's, else a GPU where there is one."""
    device = workers if asked == "auto" else asked
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    return device


def _take_over_run(work: Work) -> None:
    """Puts the checkpoint of the job that this one replaces into the run's folder, unless there is a run already."""
    before = work.request.retry_of
    if before is None or work.folder.run.exists():
        return
    old = JobFolder(work.folder.artifact_folder, before)
    if not (old.run / CHECKPOINT_FILE).exists():
        return
    outcome = old.outcome()
    if outcome is not None and outcome.error == TrainingStateInvalid.reason:
        return  # it cannot be resumed from: this job begins anew
    partial = work.folder.path / "run.partial"
    shutil.rmtree(partial, ignore_errors=True)
    with old.lock.open("a") as lock:
        fcntl.lockf(lock, fcntl.LOCK_EX)  # a process that was cancelled a moment ago may still write
        partial.mkdir()
        for name in (CHECKPOINT_FILE, JOURNAL_FILE, CONFIG_FILE):
            if (old.run / name).exists():
                shutil.copyfile(old.run / name, partial / name)
    partial.rename(work.folder.run)


def _report(work: Work, state: TrainingProgress) -> None:
    work.report(
        Progress(
            step=state.step,
            steps=state.steps,
            loss=state.loss,
            val_psnr_db=state.val_psnr_db,
            gaussians=state.gaussian_count,
            rate_per_s=state.steps_per_s,
            seconds_left=state.seconds_left if math.isfinite(state.seconds_left) else None,
        )
    )
    if state.step * _LINES // state.steps > (state.step - 1) * _LINES // state.steps:
        held_out = "" if state.val_psnr_db is None else f", held out {state.val_psnr_db:.2f} dB"
        sys.stderr.write(
            f"step {state.step:,} of {state.steps:,}: loss {state.loss:.4f}, {state.gaussian_count:,} Gaussians, "
            f"{state.steps_per_s:.1f} steps/s{held_out}\n"
        )
        sys.stderr.flush()


def _finish(work: Work, job: TrainJob, dataset: Dataset, scene: GaussianScene, device: str) -> Outcome:
    work.progress = replace(work.progress, step=scene.info.training["step"], steps=scene.info.training["steps"])
    metrics = {name: float(value) for name, value in scene.info.metrics.items()}
    with work.folder.new_artifacts() as folder:
        scene.save(folder / f"{job.scene}{SUFFIX}")
        journal = work.folder.run / JOURNAL_FILE
        shutil.copyfile(journal, folder / JOURNAL_FILE)
        draw_training_curve(journal, folder / "training_curve.png")
        document = {
            "scene": job.scene,
            "dataset": job.dataset,
            "gaussians": scene.gaussian_count,
            "held_out_mean": metrics,
            "training": scene.info.training,
        }
        (folder / "metrics.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
        if len(dataset.val):
            _draw(scene.to(device), dataset, folder)
    return Outcome(artifacts=work.folder.artifact_names(), metrics=metrics)


def _draw(scene: GaussianScene, dataset: Dataset, folder: Path) -> None:
    count = len(dataset.val)
    shown = dataset.val.select(np.linspace(0, count - 1, min(count, PICTURES)).round().astype(np.int64))
    write_side_by_side(scene, shown, evaluate(scene, shown).frames, folder)
