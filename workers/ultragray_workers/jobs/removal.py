"""Removing a job: its folder, then its row, so that no other job can have the id before the folder is gone."""

from __future__ import annotations

import contextlib
import fcntl
import time
from collections.abc import Iterator

from ..claims import out_of_sight, remove_whole
from ..errors import JobInUse
from .folder import JobFolder
from .queue import runs
from .queue.database import JobDatabase
from .shards import claims
from .shards.shares import forget_shares

_LOCK_WAIT_S = 2.0  # for the process of a job that was cancelled a moment ago
_LOCK_POLL_S = 0.05


def remove_job(jobs: JobDatabase, folder: JobFolder) -> None:
    """Removes a finished job; the scene that it made stays.

    Raises JobInUse while its process still ends, OSError, and what the database raises: then all is as before.
    """
    with contextlib.ExitStack() as stack:
        if folder.path.is_dir():
            stack.enter_context(_locked(folder))
        stack.enter_context(out_of_sight(folder.path))
        for share in forget_shares(jobs, folder.job_id):
            remove_whole(JobFolder(folder.artifact_folder, share).path)
        jobs.client.delete_workflows([folder.job_id])
        with jobs.engine.begin() as connection:
            runs.forget(connection, folder.job_id)
            claims.forget(connection, folder.job_id)


@contextlib.contextmanager
def _locked(folder: JobFolder) -> Iterator[None]:
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
