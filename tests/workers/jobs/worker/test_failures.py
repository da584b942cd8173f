"""What goes wrong for real: each such job fails with one reason that a person can read, and the next one runs."""

import os
import resource
import shutil
import signal
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from ultragray.phantom.demo import copy_demo_scene
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import StorageFull
from ultragray_workers.jobs.kinds import RenderJob
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.store import JobStore

from ....waiting import Deadline
from ..conftest import FINAL, is_training, store_dataset, train_job

DISK_BYTES = 8 * 2**20
# The loss of trainings with batches of three is NaN from the third step on.
DIVERGENCE = """
import sys
if "ultragray_workers.jobs.worker.template" in sys.orig_argv:
    from ultragray.learn.training import batch
    image_loss, calls = batch.image_loss, []
    def broken(rendered, truth, *settings):
        calls.append(None)
        return image_loss(rendered, truth, *settings) * (float("nan") if len(truth) == 3 and len(calls) > 2 else 1.0)
    batch.image_loss = broken
"""


def poses(count):
    return np.tile(np.eye(4), (count, 1, 1)).tolist()


def process_of(worker, *, not_=None, timeout_s=300.0):
    """The process of the worker's job, once there is one."""
    end = Deadline(timeout_s)
    while (process := worker.job_process()) in (None, not_):
        assert not end.passed, "no process of a job was started"
        time.sleep(0.005)
    assert process is not None
    return process


def assert_failed(job, error, *told):
    assert (job.state, job.error) == (JobState.FAILED, error), job
    assert job.reason is not None
    assert "\n" not in job.reason
    for part in told:
        assert part in job.reason


@pytest.mark.long
def test_poisoned_datasets_and_diverging_trainings(store, artifact_folder, tmp_path, start_worker, until, monkeypatch):
    images = store_dataset(artifact_folder, "images") / "images_train.npy"
    frames = np.load(images) / 255.0
    frames[2, 3, 4] = np.nan
    np.save(images, frames)
    jobs = [
        store.submit(asked)[0]
        for asked in (
            train_job("of-images", dataset="images"),
            train_job("diverging", batch_size=3),
            train_job("good"),
        )
    ]
    (tmp_path / "sitecustomize.py").write_text(DIVERGENCE)
    monkeypatch.syspath_prepend(str(tmp_path))
    start_worker()
    of_images, diverging, good = (until(job) for job in jobs)
    assert_failed(of_images, "DATASET_INVALID", "images_train.npy", "frame 2", "NaN")
    assert_failed(diverging, "TRAINING_DIVERGED", "in step 3", "the loss is nan")
    assert good.state is JobState.SUCCEEDED, good
    assert [path.name for path in (artifact_folder / "scenes").iterdir()] == ["good.ugr"]


@pytest.mark.long
def test_dataset_deleted_while_it_is_trained_from_and_the_next_job_starts_after_a_cancel(
    store, artifact_folder, start_worker, until
):
    worker = start_worker()
    store_dataset(artifact_folder, "gone")
    job, _ = store.submit(train_job("one", dataset="gone", steps=1_000_000))
    until(job, is_training)
    first = process_of(worker)
    DatasetStore(artifact_folder).delete("gone")
    os.kill(first, signal.SIGKILL)
    assert_failed(until(job), "DATASET_NOT_FOUND", "'gone'")

    job, _ = store.submit(train_job("two", steps=1_000_000))
    following, _ = store.submit(train_job("three"))
    process = process_of(worker)
    until(job, is_training)
    store.cancel(job.id)
    process_of(worker, not_=process)
    assert until(following).state is JobState.SUCCEEDED


@pytest.fixture
def small_disk(artifact_folder):
    """The artifact folder is a file system of its own, which anybody can fill."""
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", artifact_folder], capture_output=True, text=True
    )
    if mounted.returncode:
        pytest.skip(f"a small disk cannot be mounted here: {mounted.stderr.strip()}")
    store_dataset(artifact_folder, "tiny")
    yield artifact_folder
    subprocess.run(["umount", "--lazy", artifact_folder], check=True)


@pytest.mark.long
def test_full_disk(small_disk, tmp_path, start_worker):
    store = JobStore(small_disk, None)

    def until(job, reached=lambda job: job.state in FINAL):
        end = Deadline(60)
        while not reached(job):
            assert not end.passed, (job, store.log_tail(job.id), (tmp_path / "one.log").read_text())
            time.sleep(0.05)
            job = store.get(job.id)
        return job

    (small_disk / "scenes").mkdir()
    copy_demo_scene(small_disk / "scenes" / "demo.ugr")
    with pytest.raises(StorageFull, match="60 frames of 512x512 take up to 63 MB"):
        store.submit(RenderJob(scene="demo", poses=poses(60), height=512, width=512))
    job, _ = store.submit(RenderJob(scene="demo", poses=poses(12), height=256, width=256))
    with (small_disk / "ballast").open("wb") as ballast:
        os.posix_fallocate(ballast.fileno(), 0, shutil.disk_usage(small_disk).free - 2**20)
    start_worker()
    assert_failed(until(job), "STORAGE_FULL", "12 frames of 256x256 take up to 3 MB")
    (small_disk / "ballast").unlink()
    assert not (small_disk / "jobs" / job.id / "artifacts").exists()
    assert shutil.disk_usage(small_disk).free > DISK_BYTES // 2

    job, _ = store.submit(train_job("one", steps=800))
    until(job, is_training)
    with (small_disk / "ballast").open("wb") as ballast:
        os.posix_fallocate(ballast.fileno(), 0, shutil.disk_usage(small_disk).free)
    assert_failed(until(job), "STORAGE_FULL", "no room")
    (small_disk / "ballast").unlink()
    assert [path.name for path in (small_disk / "scenes").iterdir()] == ["demo.ugr"]
    assert until(store.submit(train_job("two"))[0]).state is JobState.SUCCEEDED
    store.close()


@pytest.mark.long
def test_memory_that_does_not_suffice(store, artifact_folder, start_worker, until):
    (artifact_folder / "scenes").mkdir()
    copy_demo_scene(artifact_folder / "scenes" / "demo.ugr")
    worker = start_worker()
    job, _ = store.submit(RenderJob(scene="demo", poses=poses(400), height=1024, width=1024))
    until(job, lambda job: (job.progress.frames_done or 0) > 0)
    process = process_of(worker)
    used = next(line for line in Path(f"/proc/{process}/status").read_text().splitlines() if line.startswith("VmSize"))
    half = int(used.split()[1]) * 1024 // 2  # so that no more is given, whatever was given back meanwhile
    resource.prlimit(process, resource.RLIMIT_AS, (half, half))
    assert_failed(until(job), "MEMORY_EXCEEDED", "memory of the machine")

    with memory_group() as group:
        job, _ = store.submit(train_job("one", steps=1_000_000))
        killed = set()
        while store.get(job.id).state in (JobState.QUEUED, JobState.RUNNING):
            process = worker.job_process() or 0
            if process and process not in killed:
                killed.add(process)
                (group / "cgroup.procs").write_text(str(process))
            time.sleep(0.01)
    assert_failed(store.get(job.id), "MEMORY_EXCEEDED", "memory of the machine", "3 times")
    assert len(killed) == 3
    assert until(store.submit(train_job("two"))[0]).state is JobState.SUCCEEDED


@contextmanager
def memory_group():
    """A control group in which the kernel kills what takes more than 8 MiB of its own; skips where none can be made."""
    version_1 = Path("/sys/fs/cgroup/memory")
    parent, limit = (version_1, "limit_in_bytes") if version_1.is_dir() else (version_1.parent, "max")
    group = parent / f"ultragray-test-{os.getpid()}"
    try:
        group.mkdir()
        (group / f"memory.{limit}").write_text(str(8 * 2**20))
    except OSError as error:
        pytest.skip(f"the kernel's own killing is not tried: no control group can be made here: {error}")
    try:
        yield group
    finally:
        group.rmdir()
