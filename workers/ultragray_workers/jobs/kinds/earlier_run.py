"""The run of the job that a retry replaces: what it had reached is where the retry goes on."""

from __future__ import annotations

import fcntl
import shutil
from contextlib import suppress

from ultragray.errors import TrainingStateInvalid
from ultragray.files import TEMPORARY_SUFFIX
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.worker.job_run import JobRun


def take_over_run(job_run: JobRun, begun: str) -> None:
    """Copies the run of the job that this one replaces, unless there is a run already, or that one never had `begun`.

    `begun`: the file of a run that can be gone on from.
    """
    before = job_run.request.retry_of
    if before is None or job_run.folder.run.exists():
        return
    old = JobFolder(job_run.folder.artifact_folder, before)
    if not (old.run / begun).exists():
        return
    outcome = old.outcome()
    if outcome is not None and outcome.error == TrainingStateInvalid.reason:
        return  # it cannot be resumed from: this job begins anew
    # The run before may be deleted meanwhile: then this job begins anew.
    with job_run.folder.scratch() as folder, suppress(FileNotFoundError), old.lock.open("a") as lock:
        fcntl.lockf(lock, fcntl.LOCK_EX)  # a process that was cancelled a moment ago may still write
        shutil.copytree(old.run, folder / "run", ignore=shutil.ignore_patterns(f".*{TEMPORARY_SUFFIX}"))
        (folder / "run").rename(job_run.folder.run)
