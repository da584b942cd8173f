"""Jobs with real workers, each a process of its own, on datasets that train within a second."""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.datasets.released import write_released
from ultragray.learn.sweep import Dataset, Sweep
from ultragray_workers.datasets.store import FILES_NAME, DatasetRecord, DatasetStore, write_manifest
from ultragray_workers.jobs.database import SQLITE_FILE, JobDatabase
from ultragray_workers.jobs.folder import Request
from ultragray_workers.jobs.kinds import TrainJob
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.store import JobStore

from ...waiting import Deadline

FINAL = (JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED)
PROBE = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=25.0)
PROGRAM = """
import json, os, signal, socket, sys, threading
from pathlib import Path
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.worker import supervision
from ultragray_workers.jobs.worker.worker import work
from ultragray_workers.storage.local import LocalStorage
queue.DEAD_AFTER_S = 3.0
stop = threading.Event()
signal.signal(signal.SIGTERM, lambda number, frame: stop.set())
options = json.loads(sys.argv[3])
host = options.pop("host", socket.gethostname())
supervision.LONGEST_SHARE_S = options.pop("longest_share_s", supervision.LONGEST_SHARE_S)
socket.gethostname = lambda: host
settings = {"device": "cpu", "threads": 1, "nice": 0, **options}
folder, url = Path(sys.argv[1]), os.environ.get("DATABASE_URL")
work(supervision.WorkerConfig(folder, LocalStorage(folder), url, sys.argv[2], **settings), stop)
os._exit(0)
"""


def tiny_dataset(frames=8, side=16):
    """A bright ball in grey noise; every fourth frame is held out."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 1, 3] = 0.8 * np.arange(frames)
    x, z = np.meshgrid(np.linspace(-1, 1, side), np.linspace(0, 1, side))
    ball = 140.0 * np.exp(-((x - 0.1) ** 2 + (z - 0.4) ** 2) / 0.1)
    noise = np.random.default_rng(0).normal(50.0, 4.0, (frames, side, side))
    images = np.clip(ball + noise, 0, 255).astype(np.uint8)
    held_out = np.arange(frames) % 4 == 2

    def part(chosen):
        return Sweep(images[chosen], poses[chosen], PROBE, np.arange(frames)[chosen], "tiny")

    return Dataset("tiny", part(~held_out), part(held_out))


def store_dataset(artifact_folder, name):
    """A dataset as an upload leaves it; its files."""
    dataset = tiny_dataset()
    store = DatasetStore(artifact_folder)
    folder = store.folder / f"made-{name}"
    folder.mkdir(parents=True)
    write_released(dataset, folder / FILES_NAME)
    record = DatasetRecord(
        name=name,
        kind="released",
        sha256=dataset.sha256,
        bytes=1,
        created_at="2026-01-01T00:00:00+00:00",
        train_frames=len(dataset.train),
        val_frames=len(dataset.val),
        height=16,
        width=16,
        probe=PROBE,
        warnings=(),
        options={},
    )
    write_manifest(record, folder)
    store.add(folder, name)
    shutil.rmtree(folder)
    return files_of(artifact_folder, name)


def files_of(artifact_folder, name):
    """The files of a dataset in an artifact folder, as they were sent."""
    with DatasetStore(artifact_folder).files(name) as folder:
        return folder / FILES_NAME


def request_of(specification, artifact_folder, submitted=1, **options):
    """The instructions of a worker without anything special, on the processor."""
    folder = str(artifact_folder)
    return Request(specification, submitted, None, None, "cpu", 1, 0, folder, folder, **options)


def path_of(artifact):
    """The file that an artifact is, of a folder."""
    path = artifact.storage.in_place(artifact.stored.key)
    assert path is not None
    return path


def train_job(scene, *, dataset="tiny", steps=20, max_run_s=None, **settings):
    values = {"steps": steps, "max_gaussians": 40, "batch_size": 2, **settings}
    return TrainJob(dataset=dataset, scene=scene, settings=values, device="cpu", max_run_s=max_run_s)


def is_training(job):
    return job.state is JobState.RUNNING and (job.progress.step or 0) > 0


def _children(pid):
    """The processes that one has forked for jobs, or to fork them."""
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(FileNotFoundError, ProcessLookupError):  # it has just ended, or its thread has
            for child in children.read_text().split():
                if "jobs.worker.template" in Path(f"/proc/{child}/cmdline").read_text():
                    yield int(child)


def _leads_a_session(pid):
    with suppress(ProcessLookupError):
        return os.getsid(pid) == pid


class RunningWorker:
    """A worker in a process of its own. `options` are those of `work`, and `host`: the name that its host has."""

    def __init__(self, artifact_folder, database_url, name, log, options):
        self._artifact_folder, self._database_url = artifact_folder, database_url
        with log.open("ab") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-c", PROGRAM, str(artifact_folder), name, json.dumps(options)],
                env={
                    **os.environ,
                    "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
                    **({} if database_url is None else {"DATABASE_URL": database_url}),
                },
                stdout=file,
                stderr=file,
            )

    def suspend(self):
        """Stops it, but not while it writes: a SQLite file stays locked by who is stopped."""
        with ExitStack() as stack:
            if self._database_url is None:
                database = stack.enter_context(
                    closing(sqlite3.connect(self._artifact_folder / SQLITE_FILE, timeout=300))
                )
                database.execute("BEGIN IMMEDIATE")  # once nobody else writes
            self.process.send_signal(signal.SIGSTOP)

    def kill(self):
        """As a loss of power to the worker would."""
        self.process.kill()
        self.process.wait()

    def terminate(self):
        """As a service manager does."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(300)

    def job_process(self):
        """The process of the job at hand."""
        template = self.template()
        forks = () if template is None else _children(template)
        return next(filter(_leads_a_session, forks), None)  # else it runs a program of what the template imports

    def template(self):
        """The process that forks those of jobs."""
        return next(_children(self.process.pid), None)


@pytest.fixture
def artifact_folder(tmp_path):
    folder = tmp_path / "artifacts"
    store_dataset(folder, "tiny")
    return folder


@pytest.fixture
def database_url():
    """None: a SQLite file."""
    return None


@pytest.fixture
def jobs(artifact_folder, database_url):
    jobs = JobDatabase(artifact_folder, database_url)
    yield jobs
    jobs.close()


@pytest.fixture
def store(artifact_folder, database_url):
    store = JobStore(artifact_folder, database_url, queue_limit=20)
    yield store
    store.close()


@pytest.fixture
def start_worker(artifact_folder, database_url, tmp_path):
    started = []

    def start(name="one", *, folder=artifact_folder, **options):
        started.append(RunningWorker(folder, database_url, name, tmp_path / f"{name}.log", options))
        return started[-1]

    yield start
    for worker in started:
        worker.kill()


@pytest.fixture
def until(store):
    """Waits for a job to be final, or whatever is asked for."""

    def wait(job, reached=lambda job: job.state in FINAL, timeout_s=240):
        end = Deadline(timeout_s)
        while not reached(job):
            assert not end.passed, (job, store.log_tail(job.id))
            time.sleep(0.05)
            job = store.get(job.id)
        return job

    return wait
