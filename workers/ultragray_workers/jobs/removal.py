"""Removing a job: its files, then its row, so that no other job can have the id before the files are gone."""

from __future__ import annotations

import contextlib
import fcntl
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

from ultragray_workers.errors import JobInUse
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.queue import runs
from ultragray_workers.jobs.queue.database import JobDatabase
from ultragray_workers.jobs.shards import claims
from ultragray_workers.jobs.shards.shares import forget_shares

if TYPE_CHECKING:
    from ultragray_workers.jobs.files import JobFiles

_LOCK_WAIT_S = 2.0  # for the process of a job that was cancelled a moment ago
_LOCK_POLL_S = 0.05


def remove_job(jobs: JobDatabase, files: JobFiles, job_id: str) -> None:
    """Removes a finished job; the scene that it made stays.

    Raises JobInUse while its process still ends, OSError, StorageUnavailable, and what the database raises: the job is
    still there then.
    """
    with files.removed(job_id):
        for share in forget_shares(jobs, job_id):
            with contextlib.suppress(JobInUse), files.removed(share):  # housekeeping removes what is left of it
                pass
        jobs.client.delete_workflows([job_id])
        with jobs.engine.begin() as connection:
            runs.forget(connection, job_id)
            claims.forget(connection, job_id)


@contextlib.contextmanager
def locked(folder: JobFolder) -> Iterator[None]:
    """No process works in the folder during the body. Raises JobInUse."""
    end = time.monotonic() + _LOCK_WAIT_S
    with folder.lock.open("a") as lock:
        while True:
            try:
                fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError:
                if time.monotonic() > end:
                    raise JobInUse(
                        f"the process of the job {folder.job_id} is still being stopped: try again in a moment",
                        field="job",
                    ) from None
                time.sleep(_LOCK_POLL_S)
        yield
