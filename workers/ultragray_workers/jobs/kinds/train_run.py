"""The work of a training job: a dataset becomes a scene, its metrics, its curve and a few pictures."""

from __future__ import annotations

import json
import math
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ultragray.files import write_whole
from ultragray.learn.evaluation.baselines import IN_TIME, affordable_voxel_mm, evaluate_baselines
from ultragray.learn.evaluation.scoring import evaluate, evaluate_frames
from ultragray.learn.evaluation.side_by_side import write_spread
from ultragray.learn.report.page import THIS_SCENE, Prediction, ScenePage, render_page
from ultragray.learn.report.plots import write_training_curve
from ultragray.learn.sweep import Dataset, spread_places
from ultragray.learn.training import Progress as TrainingProgress
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training import train as train_scene
from ultragray.learn.training.agreement import agreed_path
from ultragray.learn.training.confidence import BLACK_FRAMES, LEAST_HELD_OUT, MEASURED_FRAMES, held_out_frames
from ultragray.learn.training.memory import machine_in_words
from ultragray.learn.training.pictures import pictures_in
from ultragray.learn.training.poses import WITH_PATH
from ultragray.learn.training.progress import Course
from ultragray.learn.training.run import FITTING
from ultragray.learn.training.trainer import CHECKPOINT_FILE, JOURNAL_FILE, VALIDATION_FRAMES
from ultragray.scene.gaussians import GaussianScene
from ultragray_workers.jobs.files import BASELINES_NAME
from ultragray_workers.jobs.kinds.train import TrainJob
from ultragray_workers.jobs.progress import Outcome, Progress
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped
from ultragray_workers.scene_names import SUFFIX

METHODS = ("linear", "median", IN_TIME)
CHECKPOINT_INTERVAL_S = 10.0
_LINES = 20  # of the log in a run
MAX_PIXELS = 1 << 26  # of the sweep: about ten seconds; a larger one begins at once, without the lines


def write_baselines(dataset: Dataset, path: Path, should_stop: Callable[[], bool], refine_poses: str) -> None:
    """Writes the PSNR in dB of each method, by name, as JSON: by the same poses as the training's own, on its path.

    Nothing where there is a file already, no frame is held out, the sweep is too large, or it is to stop.
    """
    if path.exists() or not len(dataset.val) or dataset.train.images.size > MAX_PIXELS:
        return
    agreed = agreed_path(dataset) if refine_poses in WITH_PATH else None
    placed = dataset if agreed is None else agreed.of(dataset)
    few = replace(placed, val=placed.val.select(spread_places(len(placed.val), VALIDATION_FRAMES)))
    voxel_mm = affordable_voxel_mm(dataset.train)
    psnrs_db: dict[str, float] = {}
    for method in METHODS:
        if should_stop():
            return
        psnrs_db |= {name: one.mean.psnr_db for name, one in evaluate_baselines(few, (method,), voxel_mm).items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(psnrs_db) + "\n")


# The time that a training takes after its steps, by what it takes here to render a frame and to score one.
STEP_RENDERINGS = 3.0  # what a view of a step costs, with its gradients, in renderings of a frame
CONFIDENCE_RENDERINGS = 4.0  # of a frame by which the confidence is fitted: image, coverage and uncertainty
PLOTS_S = 5.0  # of the report, whatever it is about
PICTURES, REPORT_FRAMES = 4, 24  # held-out frames, evenly spread
_PANELS = 3  # of a frame in the report that are rendered


class Finishing:
    """The seconds from a phase to the end of the job, beside what is trained in it."""

    def __init__(self, dataset: Dataset, config: TrainingConfig) -> None:
        self._views = min(config.batch_size, len(dataset.train))
        self._score_s = _scoring_s(dataset)
        self._frame_s = 0.0
        held_out = len(dataset.val)
        measured = len(held_out_frames(dataset.train)) if config.confidence else 0
        fitted = 0 if measured < LEAST_HELD_OUT else min(measured, MEASURED_FRAMES) + MEASURED_FRAMES // 3
        picture_count = PICTURES + min(held_out, REPORT_FRAMES)
        reported = 2 * held_out if config.refine_poses in WITH_PATH else held_out  # at most: also on the path
        # renderings and scores of each phase
        self._work = {
            "evaluation": (float(held_out), held_out),
            "confidence": (CONFIDENCE_RENDERINGS * fitted, fitted + (BLACK_FRAMES if fitted else 0)),
            "report": (float(reported + _PANELS * picture_count), reported) if held_out else (0.0, 0),
        }
        self._plots_s = PLOTS_S if held_out else 0.0

    def observe(self, steps_per_s: float) -> None:
        """Takes the pace of the run, from which that of renderings follows."""
        if steps_per_s:
            self._frame_s = 1.0 / (steps_per_s * self._views * STEP_RENDERINGS)

    def seconds_from(self, phase: str) -> float:
        """The seconds that a phase and all later ones take."""
        phases = list(self._work)
        work = [self._work[one] for one in phases[phases.index(phase) :]]
        return self._plots_s + sum(frames * self._frame_s + scores * self._score_s for frames, scores in work)


def _scoring_s(dataset: Dataset) -> float:
    """The seconds of scoring a frame: measured on one."""
    frame = dataset.train.select([0])
    started = time.perf_counter()
    evaluate_frames((frame.images / 255.0).astype(np.float32), frame)
    return time.perf_counter() - started


def run(job_run: JobRun, job: TrainJob, *, better: GaussianScene | None = None, by_db: float = 0.0) -> Outcome:
    """Trains, or goes on from the checkpoint that an earlier process left, and completes the artifacts.

    `better`: another scene of the same frames, which takes the place of the trained one where it shows the held-out
    frames better `by_db` or more.

    Raises Stopped, DatasetNotFound, DatasetInvalid, InvalidArgument, and what `ultragray.learn.training.train` raises.
    """
    device = job_run.request.device
    config = TrainingConfig.preset(job.preset, **job.settings)
    dataset = job_run.load_dataset(job.dataset)
    checkpoint = job_run.folder.run / CHECKPOINT_FILE
    resume = checkpoint.exists()
    sys.stderr.write(
        f"training {job.scene} from {job.dataset} on {device}, {job_run.request.threads} threads"
        f"{', going on from a checkpoint' if resume else ''}\n"
    )
    if not resume:
        job_run.report(Progress(phase="baselines"))
        write_baselines(dataset, job_run.folder.run / BASELINES_NAME, job_run.should_stop, config.refine_poses)
    finishing = Finishing(dataset, config)
    scene = train_scene(
        dataset,
        config,
        start=_start_of(job_run, job),
        folder=job_run.folder.run,
        resume=resume,
        report=lambda state: _report(job_run, state, finishing),
        should_stop=job_run.should_stop,
        device=device,
        checkpoint_interval_s=CHECKPOINT_INTERVAL_S,
    )
    if scene.info.training["step"] < scene.info.training["steps"]:
        raise Stopped
    if better is not None and len(dataset.val):
        scene = _better(scene, better, dataset, by_db)
    return _finish(job_run, job, dataset, scene, device, finishing)


def _start_of(job_run: JobRun, job: TrainJob) -> GaussianScene | None:
    if job.start_scene is None:
        return None
    return GaussianScene.load(job_run.folder.path / f"{job.start_scene}{SUFFIX}")


def _better(scene: GaussianScene, other: GaussianScene, dataset: Dataset, by_db: float) -> GaussianScene:
    measured = evaluate(other, dataset.val).mean
    if measured.psnr_db < scene.info.metrics["psnr_db"] + by_db:
        return scene
    sys.stderr.write(f"the scene that was served before is better, {measured.psnr_db:.2f} dB: it stays\n")
    info = scene.info
    other.info = replace(
        other.info,
        metrics=measured.to_dict(),
        confidence=info.confidence,
        speckle=info.speckle,
        training={**other.info.training, "steps": other.info.training["step"]},
        dataset_sha256=info.dataset_sha256,
    )
    return other


def _report(job_run: JobRun, state: TrainingProgress, finishing: Finishing) -> None:
    if state.beside == FITTING:  # what the run itself has reached stands
        left_s = _known(state.seconds_left + finishing.seconds_from("confidence"))
        job_run.report(replace(job_run.progress, phase="confidence", seconds_left=left_s))
    elif state.beside is not None:
        job_run.report(_progress_of(state, "effort", None))
    else:
        finishing.observe(state.steps_per_s)
        phase = "training" if state.step < state.steps else "evaluation"
        job_run.report(_progress_of(state, phase, _known(state.seconds_left + finishing.seconds_from("evaluation"))))
    if state.step * _LINES // state.steps > (state.step - 1) * _LINES // state.steps:
        held_out = "" if state.val_psnr_db is None else f", held out {state.val_psnr_db:.2f} dB"
        sys.stderr.write(
            f"{'' if state.beside is None else f'{state.beside}: '}"
            f"step {state.step:,} of {state.steps:,}: loss {state.loss:.4f}, {state.gaussian_count:,} Gaussians, "
            f"{state.steps_per_s:.1f} steps/s{held_out}\n"
        )
        sys.stderr.flush()


def _known(seconds: float) -> float | None:
    return seconds if math.isfinite(seconds) else None


def _progress_of(state: TrainingProgress, phase: str, seconds_left: float | None) -> Progress:
    return Progress(
        phase=phase,
        step=state.step,
        steps=state.steps,
        loss=state.loss,
        val_psnr_db=state.val_psnr_db,
        gaussians=state.gaussian_count,
        rate_per_s=state.steps_per_s,
        seconds_left=seconds_left,
    )


def _finish(
    job_run: JobRun, job: TrainJob, dataset: Dataset, scene: GaussianScene, device: str, finishing: Finishing
) -> Outcome:
    step, steps = scene.info.training["step"], scene.info.training["steps"]
    left_s = finishing.seconds_from("report")
    job_run.report(replace(job_run.progress, phase="report", step=step, steps=steps, seconds_left=left_s))
    metrics = {name: float(value) for name, value in scene.info.metrics.items()}
    with job_run.folder.new_artifacts() as folder:
        scene.save(folder / f"{job.scene}{SUFFIX}")
        journal = job_run.folder.run / JOURNAL_FILE
        beside = (job_run.folder.run / BASELINES_NAME, *pictures_in(job_run.folder.run))
        for path in (journal, *(one for one in beside if one.exists())):
            shutil.copyfile(path, folder / path.name)
        write_training_curve(Course.of_journal(journal), folder / "training_curve.png")
        document = {
            "scene": job.scene,
            "dataset": job.dataset,
            "gaussians": scene.gaussian_count,
            "held_out_mean": metrics,
            "training": scene.info.training,
        }
        (folder / "metrics.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
        if len(dataset.val):
            _write_report(job, dataset, scene.to(device), folder, machine_in_words(device))
    job_run.progress = replace(job_run.progress, phase=None, seconds_left=0.0)
    return Outcome(artifacts=job_run.folder.artifact_names(), metrics=metrics)


def _write_report(job: TrainJob, dataset: Dataset, scene: GaussianScene, artifacts: Path, machine: str) -> None:
    """Pictures of some held-out frames, and the page of the scene."""
    prediction = Prediction.of_scene(scene, dataset)
    write_spread(scene, dataset.val, prediction.evaluation, artifacts, PICTURES)
    page = ScenePage(
        dataset,
        scene,
        {THIS_SCENE: prediction},
        machine,
        scene_name=job.scene,
        spread=REPORT_FRAMES,
        course=Course.of_journal(artifacts / JOURNAL_FILE),
    )
    (artifacts / "report.html").write_text(render_page(page), encoding="utf-8")
