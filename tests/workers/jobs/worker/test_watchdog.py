"""Jobs that get stuck, and jobs that take too long."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path

import pytest

from ultragray_workers.jobs import queue
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.worker import process as watchdog
from ultragray_workers.jobs.worker.process import Watchdog, kill_group

from ....waiting import wait_until
from ..conftest import is_training, train_job

FOR_EVER = 1_000_000  # steps
LONGEST_S = 1000.0


@contextmanager
def running(program):
    """A process that has begun, and goes with all below it."""
    process = subprocess.Popen(
        [sys.executable, "-c", f"print(flush=True)\n{program}"], stdout=-1, start_new_session=True
    )
    process.stdout.readline()
    yield process.pid
    kill_group(process.pid)
    process.communicate()


@pytest.mark.long
@pytest.mark.parametrize(
    ("program", "gets_on"),
    [
        ("while True: pass", True),
        ("import time, os\nwhile True: time.sleep(0.1); os.write(os.open('/dev/null', os.O_WRONLY), b'x')", True),
        ("import subprocess, sys\nsubprocess.run([sys.executable, '-c', 'while True: pass'])", True),
        ("import time; time.sleep(3600)", False),
        ("import time\nwhile True: time.sleep(0.2)", False),
        ("import os, signal\nos.kill(os.getpid(), signal.SIGSTOP)", False),
        ("import threading; lock = threading.Lock(); lock.acquire(); lock.acquire()", False),
    ],
)
def test_gets_on_is_what_computes_or_moves_bytes(program, gets_on):
    with running(program) as pid:
        dog = Watchdog(pid, 3.0)

        def is_stalled():
            dog.look()
            return dog.is_stalled

        if not gets_on:
            wait_until(is_stalled, every_s=0.1)
            return
        for _ in range(60):
            assert not is_stalled()
            time.sleep(0.1)


def test_time_in_which_the_worker_itself_was_stopped_does_not_count(monkeypatch):
    now_s = 0.0
    monkeypatch.setattr(watchdog.time, "monotonic", lambda: now_s)
    with running("import time; time.sleep(3600)") as pid:
        dog = Watchdog(pid, 100.0)
        dog.look()
        now_s = 10_000.0
        assert dog.look() == watchdog.LONGEST_STEP_S
        assert not dog.is_stalled


@pytest.mark.long
def test_a_stopped_process_is_noticed_and_keeps_no_device(store, start_worker, until):
    worker = start_worker(stall_timeout_s=3.0)
    job, _ = store.submit(train_job("one", steps=FOR_EVER))
    until(job, is_training)
    process = worker.job_process()
    os.kill(process, signal.SIGTERM)  # leaves a checkpoint
    process = wait_until(lambda: found if (found := worker.job_process()) != process else None)
    until(job, lambda job: "from a checkpoint" in store.log_tail(job.id))
    os.kill(process, signal.SIGSTOP)
    following, _ = store.submit(train_job("two"))

    job = until(job)
    assert (job.state, job.error) == (JobState.FAILED, "JOB_STALLED"), job
    assert "neither computed nor read nor wrote for 3 s" in (job.reason or "")
    assert not Path(f"/proc/{process}").exists()
    assert until(following).state is JobState.SUCCEEDED
    successor, _ = store.retry(job.id)
    until(successor, lambda job: "from a checkpoint" in store.log_tail(job.id))
    store.cancel(successor.id)


@pytest.mark.long
@pytest.mark.parametrize("of", ["the request", "the worker"])
def test_a_job_runs_for_its_longest_time_in_all_and_a_retry_goes_on(store, start_worker, until, of):
    began, engine = datetime.now(timezone.utc), store.database.engine
    asked = train_job("one", steps=FOR_EVER, max_run_s=LONGEST_S if of == "the request" else 2 * LONGEST_S)
    limits = {"max_run_s": 0.0 if of == "the request" else LONGEST_S}
    worker = start_worker("one", **limits)
    job, _ = store.submit(asked, owner="ada", private=True)
    assert (job.owner, job.private, store.unfinished_of("ada"), store.unfinished_of("bob")) == ("ada", True, 1, 0)
    until(job, is_training)
    assert worker.terminate() == 0  # writes a checkpoint
    row = queue.row_of(engine, job.id)
    assert 0.0 < row.run_s == store.usage_s("ada", began)["cpu"]
    queue.add_run_time(engine, row, "cpu", LONGEST_S - row.run_s - 1.0)

    start_worker("one", **limits)
    job = until(job)
    assert (job.state, job.error, job.attempts) == (JobState.FAILED, "JOB_TIME_EXCEEDED", 2), job
    assert f"ran for {LONGEST_S:g} s" in (job.reason or "")
    used_s = store.usage_s("ada", began)
    assert used_s["cpu"] >= LONGEST_S
    assert (used_s["gpu"], store.unfinished_of("ada")) == (0.0, 0)
    assert store.usage_s("bob", began) == {"cpu": 0.0, "gpu": 0.0}

    successor, _ = store.retry(job.id)
    successor = until(successor, is_training)
    assert (successor.owner, successor.private, successor.specification["max_run_s"]) == ("ada", True, asked.max_run_s)
    assert "from a checkpoint" in store.log_tail(successor.id)
    store.cancel(successor.id)
    store.delete(job.id)
    assert store.usage_s("ada", began)["cpu"] >= used_s["cpu"]
