"""Jobs done by real workers, which are killed, stopped and replaced."""

import os
import signal
import subprocess
import sys
import time

import pytest

from ultragray_workers.errors import StartupFailed
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.worker.worker import claim_name

from ..conftest import train_job


def is_training(job):
    return job.state is JobState.RUNNING and (job.progress.step or 0) > 0


def test_name_of_a_worker_is_its_alone(tmp_path):
    with pytest.raises(StartupFailed, match="name must be"), claim_name(tmp_path, "a/b"):
        pass
    program = (
        f"import sys; sys.path[:] = {sys.path!r}\nfrom pathlib import Path\n"
        "from ultragray_workers.jobs.worker.worker import claim_name\n"
        f"with claim_name(Path({str(tmp_path)!r}), None) as name: print(name[-2:])\n"
        f"with claim_name(Path({str(tmp_path)!r}), 'mine'): pass"
    )
    with claim_name(tmp_path, None) as name, claim_name(tmp_path, "mine"):
        assert name.endswith("-0")
        told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert told.stdout.strip() == "-1"
    assert "another worker is called 'mine'" in told.stderr
    with claim_name(tmp_path, "mine"):
        pass


def test_process_that_dies_again_and_again_is_given_up(store, start_worker, until):
    job, _ = store.submit(train_job("one", steps=1_000_000))
    worker = start_worker()
    ended = set()
    while store.get(job.id).state in (JobState.QUEUED, JobState.RUNNING):
        process = worker.job_process()
        if process is not None and process not in ended:
            ended.add(process)
            os.kill(process, signal.SIGSEGV)
        time.sleep(0.05)
    job = store.get(job.id)
    assert (job.state, job.error) == (JobState.FAILED, "INTERNAL")
    assert "3 times" in (job.reason or "")
    assert "SIGSEGV" in (job.reason or "")
    assert len(ended) == 3
