"""`ultragray worker`, and the worker that the service brings along."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import httpx
import pytest

from ultragray.phantom.demo import copy_demo_scene
from ultragray.samplers import AroundSampler
from ultragray_workers.jobs.kinds import RenderJob
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.record import Job
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.scenes import SceneStore

from ...waiting import Deadline, wait_until
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


def children(pid: int) -> dict[int, str]:
    """The processes that a process started, and their command lines."""
    found = {}
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in path.read_text().split():
            with suppress(FileNotFoundError):  # it has ended
                found[int(child)] = Path(f"/proc/{child}/cmdline").read_text().replace("\0", " ")
    return found


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


@pytest.mark.long
@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--device", "cuda:99"), "device must be one of this host, got 'cuda:99'"),
        (("--device", "tpu"), "device must be auto, cpu, cuda or cuda:N, got 'tpu'"),
        (("--label", "lab1"), "--label takes NAME=VALUE, got 'lab1'"),
        (("--label", "site=lab 1"), "label must be names and values of 1 to 63 letters"),
    ],
)
def test_worker_command_refuses_devices_that_are_not_there_and_labels_that_are_none(
    options: tuple[str, str], told: str, tmp_path: Path
) -> None:
    done = subprocess.run([*WORKER, "--artifact-folder", str(tmp_path), *options], capture_output=True, text=True)
    assert done.returncode == 2
    assert told in " ".join(done.stderr.split())


def test_worker_command_refuses_a_folder_that_is_not_there(tmp_path: Path) -> None:
    done = subprocess.run([*WORKER, "--data-folder", str(tmp_path / "none")], capture_output=True, text=True)
    assert done.returncode == 2
    assert "artifact_folder must be an existing folder" in " ".join(done.stderr.split())


def test_embedded_worker_comes_back_and_goes_with_the_service(
    start_service: StartService, demo_store: JobStore, tmp_path: Path
) -> None:
    service = start_service(artifact_folder=tmp_path / "artifacts", embedded_worker=True, training_threads=1)

    def worker() -> int | None:
        return next((pid for pid, line in children(service.process.pid).items() if "cli.worker" in line), None)

    wait_until(lambda: worker() is not None)
    first = worker()
    assert first is not None
    os.kill(first, signal.SIGKILL)
    wait_until(lambda: worker() not in (None, first))
    second = worker()
    job = until_final(demo_store, demo_store.submit(JOB)[0])
    assert job.state is JobState.SUCCEEDED, job
    assert httpx.get(f"{service.http}/v1/health/ready", timeout=60).status_code == 200
    assert service.terminate() == 0
    assert not Path(f"/proc/{second}").exists()
    assert sum("the worker for jobs ended with -9" in record["message"] for record in service.log()) == 1
    demo_store.close()
