"""Jobs done by real workers, which are killed, stopped and replaced."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from ultragray.errors import FrameTooCostly
from ultragray_workers.errors import StartupFailed
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.worker import run_job
from ultragray_workers.jobs.worker.job_run import JobRun
from ultragray_workers.jobs.worker.worker import claim_name

from ..conftest import request_of, train_job


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


def failing(error):
    def run(_):
        raise error

    return SimpleNamespace(run=run)


def outcome_of(error, folder, monkeypatch):
    job_folder = JobFolder(folder, "one")
    job_folder.path.mkdir(parents=True)
    monkeypatch.setattr(run_job, "from_dict", lambda specification: failing(error))
    return run_job._outcome_of(JobRun(job_folder, request_of({}, folder), lambda: False))


def test_neither_the_reason_nor_the_log_of_a_fault_names_a_folder(tmp_path, monkeypatch, capsys):
    message = f"cannot use '/srv/secret/tiny/conf.json', {tmp_path}/scenes/one.ugr or http://host/a/b"
    outcome = outcome_of(RuntimeError(message), tmp_path, monkeypatch)
    assert outcome.error == "INTERNAL"
    assert outcome.reason.endswith("RuntimeError: cannot use 'conf.json', scenes/one.ugr or http://host/a/b")
    log = capsys.readouterr().err
    assert 'File "test_worker.py"' in log
    assert "/srv" not in log
    assert str(Path(__file__).parent) not in log


def test_a_frame_that_is_too_costly_is_told_with_its_pose(tmp_path, monkeypatch):
    outcome = outcome_of(FrameTooCostly("a frame may cost less", field="poses[3]"), tmp_path, monkeypatch)
    assert (outcome.error, outcome.reason) == ("FRAME_TOO_COSTLY", "poses[3]: a frame may cost less")
