"""The end of a job's process, as callers are told it."""

from pathlib import Path
from types import SimpleNamespace

from ultragray.errors import FrameTooCostly
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.worker import run_job
from ultragray_workers.jobs.worker.job_run import JobRun

from ..conftest import request_of


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
    assert 'File "test_run_job.py"' in log
    assert "/srv" not in log
    assert str(Path(__file__).parent) not in log


def test_a_frame_that_is_too_costly_is_told_with_its_pose(tmp_path, monkeypatch):
    outcome = outcome_of(FrameTooCostly("a frame may cost less", field="poses[3]"), tmp_path, monkeypatch)
    assert (outcome.error, outcome.reason) == ("FRAME_TOO_COSTLY", "poses[3]: a frame may cost less")
