"""One job at a time on a device, whoever works for the host."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ultragray_workers.jobs.folder import JobFolder, Progress, Request
from ultragray_workers.jobs.store import Job, JobState, JobStore
from ultragray_workers.jobs.worker.device import device_alone, lock_path
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped

from ....waiting import at_this_load
from ..conftest import RunningWorker, train_job

HOLDER = """
import fcntl, sys
file = open(sys.argv[1], "a")
fcntl.lockf(file, fcntl.LOCK_EX)
print("held", flush=True)
sys.stdin.read()
"""


@contextmanager
def held(path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Another process has the lock."""
    path.parent.mkdir(parents=True, exist_ok=True)
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
    )
    assert holder.stdout is not None
    assert holder.stdout.readline() == b"held\n"
    yield holder
    holder.kill()
    holder.communicate()


def work_of(folder: Path, should_stop: Callable[[], bool]) -> JobRun:
    job = JobFolder(folder, "job")
    job.path.mkdir(parents=True)
    return JobRun(job, Request({}, None, "cpu", 1, 0), should_stop)


def test_waits_for_the_device_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with held(lock_path(tmp_path, "cpu")) as holder:
        looks: list[Progress] = []

        def look() -> bool:
            looks.append(work.folder.progress())
            if len(looks) == 3:
                holder.kill()
            return False

        work = work_of(tmp_path, look)
        with device_alone(work, "cuda:1"):  # another device
            assert not looks
        with device_alone(work, "cpu"):
            assert len(looks) >= 3
            assert work.progress == Progress()
    assert looks[0].waits_for == "cpu"
    assert capsys.readouterr().err == "waits for cpu: another job of this host is at work on it\n"


def test_stops_while_it_waits(tmp_path: Path) -> None:
    work = work_of(tmp_path, lambda: True)
    with held(lock_path(tmp_path, "cpu")), pytest.raises(Stopped), device_alone(work, "cpu"):
        pass


def test_gpu_is_one_device_by_any_name(tmp_path: Path) -> None:
    assert lock_path(tmp_path, "cuda") == lock_path(tmp_path, "cuda:0")
    assert len({lock_path(tmp_path, device) for device in ("cpu", "cuda:0", "cuda:1")}) == 3


@pytest.mark.long
def test_two_workers_of_a_host_do_one_job_at_a_time(
    store: JobStore, start_worker: Callable[..., RunningWorker], until: Callable[..., Job]
) -> None:
    workers = {name: start_worker(name) for name in ("one", "two")}
    first, _ = store.submit(train_job("first", steps=1_000_000))
    until(first, lambda job: (job.progress.step or 0) > 0)
    second, _ = store.submit(train_job("second"))
    second = until(second, lambda job: job.progress.waits_for == "cpu")
    assert second.state is JobState.RUNNING
    assert "waits for cpu" in store.log_tail(second.id)
    process = workers[second.worker or ""].job_process()
    cancelled_at = time.monotonic()
    assert store.cancel(second.id).progress.waits_for is None
    while Path(f"/proc/{process}").exists():
        assert time.monotonic() - cancelled_at < at_this_load(1.0)
        time.sleep(0.01)

    third, _ = store.submit(train_job("third"))
    until(third, lambda job: job.progress.waits_for == "cpu")
    assert store.get(first.id).state is JobState.RUNNING
    store.cancel(first.id)
    third = until(third)
    assert (third.state, third.progress.waits_for) == (JobState.SUCCEEDED, None), third
