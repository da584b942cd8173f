"""The work of a training job: a dataset becomes a scene, its metrics, its curve and a few pictures."""

from __future__ import annotations

import json
import math
import shutil
import sys
from dataclasses import replace
from pathlib import Path

from ultragray.learn.evaluation.side_by_side import write_spread
from ultragray.learn.report.page import THIS_SCENE, Prediction, ScenePage, render_page
from ultragray.learn.report.plots import write_training_curve
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import Progress as TrainingProgress
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training import train as train_scene
from ultragray.learn.training.memory import machine_in_words
from ultragray.learn.training.pictures import pictures_in
from ultragray.learn.training.progress import Course
from ultragray.learn.training.run import FITTING
from ultragray.learn.training.trainer import CHECKPOINT_FILE, JOURNAL_FILE
from ultragray.scene.gaussians import GaussianScene
from ultragray_workers.jobs.files import BASELINES_NAME
from ultragray_workers.jobs.kinds.train import TrainJob
from ultragray_workers.jobs.kinds.training.baselines import write_baselines
from ultragray_workers.jobs.kinds.training.remaining import PICTURES, REPORT_FRAMES, Finishing
from ultragray_workers.jobs.record import Outcome, Progress
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped
from ultragray_workers.scene_names import SUFFIX

CHECKPOINT_INTERVAL_S = 10.0
_LINES = 20  # of the log in a run


def run(job_run: JobRun, job: TrainJob) -> Outcome:
    """Trains, or goes on from the checkpoint that an earlier process left, and completes the artifacts.

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
        write_baselines(dataset, job_run.folder.run / BASELINES_NAME, job_run.should_stop)
    finishing = Finishing(dataset, config)
    scene = train_scene(
        dataset,
        config,
        folder=job_run.folder.run,
        resume=resume,
        report=lambda state: _report(job_run, state, finishing),
        should_stop=job_run.should_stop,
        device=device,
        checkpoint_interval_s=CHECKPOINT_INTERVAL_S,
    )
    if scene.info.training["step"] < scene.info.training["steps"]:
        raise Stopped
    return _finish(job_run, job, dataset, scene, device, finishing)


def _report(job_run: JobRun, state: TrainingProgress, finishing: Finishing) -> None:
    if state.beside == FITTING:  # what the run itself has reached stands
        left_s = _known(state.seconds_left + finishing.seconds_from("confidence"))
        job_run.report(replace(job_run.progress, phase="confidence", seconds_left=left_s))
    elif state.beside is not None:
        job_run.report(_told(state, "effort", None))
    else:
        finishing.observe(state.steps_per_s)
        phase = "training" if state.step < state.steps else "evaluation"
        job_run.report(_told(state, phase, _known(state.seconds_left + finishing.seconds_from("evaluation"))))
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


def _told(state: TrainingProgress, phase: str, seconds_left: float | None) -> Progress:
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
    prediction = Prediction.of_scene(scene, dataset.val)
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
