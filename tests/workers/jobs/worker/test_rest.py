"""Workers that are to rest: paused, drained, resumed, and stopped by a service manager."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from ultragray.phantom.demo import copy_demo_scene
from ultragray_workers.errors import WorkerNotFound
from ultragray_workers.jobs.kinds import RenderJob
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.workers import Wanted, WorkerState

from ....waiting import wait_until
from ..conftest import train_job


def worker_of(store, name):
    return next((worker for worker in store.workers() if worker.name == name), None)


def reaches(store, name, state):
    wait_until(lambda: (worker := worker_of(store, name)) is not None and worker.state is state)


def is_under_way(job):
    return (job.progress.step or 0) > 0


def render_job(frames):
    return RenderJob(scene="demo", poses=np.tile(np.eye(4), (frames, 1, 1)), height=64, width=64)


@pytest.mark.long
def test_worker_tells_who_it_is_and_what_it_does(store, start_worker, until):
    running = start_worker()
    reaches(store, "one", WorkerState.IDLE)
    job = until(store.submit(train_job("made", steps=1_000_000))[0], is_under_way)
    reaches(store, "one", WorkerState.WORKING)
    worker = worker_of(store, "one")
    assert (worker.pid, worker.device, worker.job) == (running.process.pid, "cpu", job.id)
    assert worker.version
    assert worker.started_at
    assert worker.seconds_since_beat is not None
    running.kill()
    reaches(store, "one", WorkerState.LOST)
    with pytest.raises(WorkerNotFound, match="there is no worker 'two'; known workers: one"):
        store.want("two", Wanted.PAUSE)


@pytest.mark.long
def test_paused_worker_ends_its_job_and_takes_no_other_until_it_is_resumed(store, start_worker, until):
    running = start_worker()
    first = until(store.submit(train_job("first", steps=150))[0], is_under_way)
    assert store.want("one", Wanted.PAUSE).state is WorkerState.PAUSING
    second, _ = store.submit(train_job("second"))
    assert until(first).state is JobState.SUCCEEDED
    reaches(store, "one", WorkerState.PAUSED)
    assert running.terminate() == 0
    start_worker()  # a restart does not end the pause
    reaches(store, "one", WorkerState.PAUSED)
    assert store.get(second.id).state is JobState.QUEUED
    assert store.get(second.id).attempts == 0
    store.want("one", Wanted.WORK)
    assert until(second).state is JobState.SUCCEEDED


@pytest.mark.long
def test_training_of_a_drained_worker_goes_on_at_another(store, start_worker, until):
    start_worker()
    job = until(store.submit(train_job("made", steps=1_500))[0], is_under_way)
    store.want("one", Wanted.DRAIN)
    reaches(store, "one", WorkerState.DRAINED)
    assert store.get(job.id).state is JobState.QUEUED
    start_worker("two")
    job = until(job)
    assert (job.state, job.worker) == (JobState.SUCCEEDED, "two"), job
    assert "going on from a checkpoint" in store.log_tail(job.id)


@pytest.mark.long
@pytest.mark.parametrize(("drain_timeout_s", "state"), [(120.0, JobState.SUCCEEDED), (0.0, JobState.QUEUED)])
def test_job_without_checkpoints_has_its_time_when_the_worker_is_stopped(
    drain_timeout_s, state, store, artifact_folder, start_worker, until
):
    (artifact_folder / "scenes").mkdir()
    copy_demo_scene(artifact_folder / "scenes" / "demo.ugr")
    running = start_worker(drain_timeout_s=drain_timeout_s)
    job = until(store.submit(render_job(400))[0], lambda job: (job.progress.frames or 0) > 0)
    assert running.terminate() == 0
    assert store.get(job.id).state is state


@pytest.mark.long
def test_a_second_signal_ends_the_drain_of_a_worker_at_once(store, artifact_folder, tmp_path, until):
    (artifact_folder / "scenes").mkdir()
    copy_demo_scene(artifact_folder / "scenes" / "demo.ugr")
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        "ULTRAGRAY_JOB_DRAIN_TIMEOUT_S": "3600",
    }
    command = [sys.executable, "-c", "from ultragray_service.cli.app import app; app()", "worker", "--device", "cpu"]
    with (tmp_path / "log").open("wb") as log:
        worker = subprocess.Popen(
            [*command, "--artifact-folder", str(artifact_folder)], env=environment, stdout=log, stderr=log
        )
    try:
        job = until(store.submit(render_job(100_000))[0], lambda job: (job.progress.frames_done or 0) > 0)
        worker.send_signal(signal.SIGTERM)
        with pytest.raises(subprocess.TimeoutExpired):
            worker.wait(1)  # the job has an hour to end
        worker.send_signal(signal.SIGINT)
        assert worker.wait(300) == 0
        assert store.get(job.id).state is JobState.QUEUED
    finally:
        worker.kill()
