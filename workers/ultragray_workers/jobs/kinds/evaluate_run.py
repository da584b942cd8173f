"""The work of an evaluation: scores of every held-out frame, and a few pictures. Interrupted, it begins anew."""

from __future__ import annotations

import json
import sys

from ultragray.files import file_sha256
from ultragray.learn.evaluation.baselines import IN_TIME, affordable_voxel_mm, evaluate_baselines
from ultragray.learn.evaluation.held_out import score_held_out
from ultragray.learn.evaluation.scoring import (
    check_same_origin,
    evaluate,
    measure_reliability,
    require_frames,
)
from ultragray.learn.evaluation.side_by_side import write_spread
from ultragray.learn.training.memory import training_device
from ultragray.scene.gaussians import GaussianScene
from ultragray_workers.jobs.kinds.evaluate import EvaluateJob
from ultragray_workers.jobs.progress import Outcome
from ultragray_workers.jobs.worker.job_run import JobRun
from ultragray_workers.scene_names import SUFFIX

RESULT_FILE = "evaluation.json"
PICTURES = 8  # held-out frames, evenly spread


def run(job_run: JobRun, job: EvaluateJob) -> Outcome:
    """Scores the scene, and where asked the baselines, and writes evaluation.json and side-by-side pictures.

    Raises Stopped, DatasetNotFound, DatasetInvalid also for a dataset without held-out frames or of another kind of
    probe, SceneFileInvalid, InvalidImageSize.
    """
    device = training_device(job_run.request.device, "auto")
    path = job_run.folder.path / f"{job.scene}{SUFFIX}"
    dataset = job_run.load_dataset(job.dataset)
    require_frames(dataset.val)
    scene = GaussianScene.load(path).to(device)
    warnings = check_same_origin(scene.info, dataset)
    for warning in warnings:
        sys.stderr.write(f"warning: {warning}\n")
    sys.stderr.write(f"scoring {job.scene} on {len(dataset.val):,} frames of {job.dataset} on {device}\n")
    evaluation = evaluate(scene, dataset.val, after_portion=job_run.counter(len(dataset.val)))
    held_out = score_held_out(scene, dataset, evaluation, register=job.register)
    reliability = measure_reliability(scene, dataset.val)
    voxel_mm = affordable_voxel_mm(dataset.train)
    baselines = evaluate_baselines(dataset, voxel_mm=voxel_mm) if job.baselines else {}
    if job.baselines and IN_TIME not in baselines:
        sys.stderr.write("the held-out frames are of another recording: they have no neighbours in time\n")
    document = {
        "scene": job.scene,
        "scene_sha256": file_sha256(path),
        "dataset": job.dataset,
        "dataset_sha256": dataset.sha256,
        "warnings": warnings,
        **evaluation.to_dict(),
        "held_out": held_out.to_dict(),
        "uncertainty": None if reliability is None else reliability.to_dict(),
        "baselines": {method: scores.to_dict() for method, scores in baselines.items()},
        "voxel_mm": voxel_mm if baselines else None,
    }
    metrics = evaluation.mean.to_dict() | evaluation.speckle.figures() | held_out.figures()
    metrics |= {} if reliability is None else reliability.figures()
    for method, scores in baselines.items():
        metrics |= {f"{method}_{name}": value for name, value in scores.mean.to_dict().items()}
    with job_run.folder.new_artifacts() as folder:
        (folder / RESULT_FILE).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
        write_spread(scene, dataset.val, evaluation, folder, PICTURES)
    return Outcome(artifacts=job_run.folder.artifact_names(), metrics=metrics)
