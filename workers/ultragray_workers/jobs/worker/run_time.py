"""The time that a job's processes run, over all attempts and workers: limited, and counted for the job's owner."""

from __future__ import annotations

from contextlib import suppress

from ultragray_workers.errors import DatabaseUnavailable, StorageFull
from ultragray_workers.jobs.queue import runs
from ultragray_workers.jobs.queue.database import JobDatabase

_SAVE_EVERY_S = 5.0


class RunTime:
    """The run time of one job, kept in the database."""

    def __init__(self, jobs: JobDatabase, job_id: str, owner: str | None, device: str, limits_s: list[float]) -> None:
        """`limits_s`: the longest times that the job may run; 0: any. Raises DatabaseUnavailable."""
        self._engine, self._key = jobs.engine, (job_id, owner, device)
        self._total_s = runs.run_s(jobs.engine, job_id)
        self._unsaved_s = 0.0
        self.limit_s = min(filter(None, limits_s), default=float("inf"))

    @property
    def is_over(self) -> bool:
        """Whether the job has run as long as it may."""
        return self._total_s >= self.limit_s

    def add(self, seconds: float) -> None:
        """Counts time of a process."""
        self._total_s += seconds
        self._unsaved_s += seconds
        if self._unsaved_s >= _SAVE_EVERY_S:
            self.save()

    def save(self) -> None:
        """Writes what was counted; while the database is away it is kept for the next time."""
        with suppress(DatabaseUnavailable, StorageFull):
            runs.add_run(self._engine, *self._key, self._unsaved_s)
            self._unsaved_s = 0.0
