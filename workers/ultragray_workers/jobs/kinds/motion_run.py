"""The work of a motion job: a scene becomes one that moves. Interrupted, it begins anew."""

from __future__ import annotations

import json
import time

from ultragray.learn.motion import add_motion, numbers_of
from ultragray.learn.motion_fields import field_of_voxels
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.label_maps import read_vector_field
from ultragray_workers.jobs.kinds.base import carried_name
from ultragray_workers.jobs.kinds.motion import MotionJob
from ultragray_workers.jobs.progress import Outcome, Progress
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped
from ultragray_workers.scene_names import SUFFIX

FACTS_FILE = "motion.json"


def run(job_run: JobRun, job: MotionJob) -> Outcome:
    """Writes the scene that moves and motion.json. Raises Stopped, DatasetNotFound, and what `add_motion` raises."""
    scene = GaussianScene.load(job_run.folder.path / f"{job.scene}{SUFFIX}")
    sweep = None if job.dataset is None else job_run.load_dataset(job.dataset).train
    numbers = None if sweep is None or job.numbers is None else numbers_of(sweep, job.numbers, "numbers")
    field = None
    if (name := carried_name(job_run.request.specification)) is not None and job.field_leads is not None:
        voxels = read_vector_field(job_run.folder.path / name, job.field_axes)
        field = field_of_voxels(voxels, scene.info, job.field_leads, job.link())
    began_s = time.monotonic()

    def report(done: int, loss: float) -> None:
        if job_run.should_stop():
            raise Stopped
        rate = done / (time.monotonic() - began_s)
        left_s = (job.steps - done) / rate
        job_run.report(Progress(step=done, steps=job.steps, loss=loss, rate_per_s=rate, seconds_left=left_s))

    added = add_motion(scene, job, sweep=sweep, numbers=numbers, field=field, report=report)
    with job_run.folder.new_artifacts() as folder:
        added.scene.save(folder / f"{job.into}{SUFFIX}")
        (folder / FACTS_FILE).write_text(json.dumps(added.facts(), indent=1) + "\n", encoding="utf-8")
    return Outcome(artifacts=job_run.folder.artifact_names())
