"""`ultragray worker`, and the worker that the service brings along."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from ultragray.phantom.demo import copy_demo_scene
from ultragray.samplers import AroundSampler
from ultragray_workers.jobs.kinds import RenderJob
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.record import Job
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.scenes import SceneStore

from ...waiting import Deadline
from ..conftest import RunningService

StartService = Callable[..., RunningService]
JOB = RenderJob(scene="demo", sampler=AroundSampler(2), height=16, width=16)
WORKER = [sys.executable, "-c", "from ultragray_service.cli.app import app; app()", "worker"]


def until_final(store: JobStore, job: Job) -> Job:
    end = Deadline(60)
    while job.state in (JobState.QUEUED, JobState.RUNNING):
        assert not end.passed, store.log_tail(job.id)
        time.sleep(0.05)
        job = store.get(job.id)
    return job


@pytest.fixture
def demo_store(tmp_path: Path) -> JobStore:
    (tmp_path / "data").mkdir()
    copy_demo_scene(tmp_path / "data" / "demo.ugr")
    return JobStore(tmp_path / "artifacts", None, scenes=SceneStore(tmp_path / "data"))


@pytest.mark.slow
def test_worker_command_does_a_job_and_stops(demo_store: JobStore, tmp_path: Path) -> None:
    job, _ = demo_store.submit(JOB)
    options = ["--artifact-folder", str(tmp_path / "artifacts"), "--name", "mine", "--device", "cpu", "--threads", "1"]
    process = subprocess.Popen([*WORKER, *options], stderr=subprocess.PIPE, text=True)
    try:
        job = until_final(demo_store, job)
        assert (job.state, job.worker) == (JobState.SUCCEEDED, "mine"), job
    finally:
        process.send_signal(signal.SIGTERM)
        _, told = process.communicate(timeout=60)
    assert process.returncode == 0, told
    messages = [json.loads(line)["message"] for line in told.splitlines()]
    assert "worker mine takes jobs" in messages
    assert f"job {job.id} succeeded" in messages
    assert messages[-1] == "worker mine stopped"
    demo_store.close()
