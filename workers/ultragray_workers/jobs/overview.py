"""The jobs of a database in numbers, for those who watch a service."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from .job import STATUSES, JobState
from .queue import unfinished
from .queue.attendance import WorkerState, list_workers
from .queue.database import JobDatabase
from .queue.listing import count_by_status


@dataclass(frozen=True)
class JobsOverview:
    """How many jobs and workers there are in each state, and how long the job has waited that waits longest.

    Empty where it is not known.
    """

    counts: Mapping[JobState, int] = field(default_factory=dict)
    workers: Mapping[WorkerState, int] = field(default_factory=dict)
    oldest_waiting_s: float = 0.0  # 0: none waits


def overview(jobs: JobDatabase) -> JobsOverview:
    """The jobs as they are now. Raises DatabaseUnavailable."""
    found = count_by_status(jobs)
    states = [worker.state for worker in list_workers(jobs)]
    oldest_ms = unfinished.oldest_waiting_ms(jobs)
    return JobsOverview(
        counts={state: sum(found.get(status, 0) for status in statuses) for state, statuses in STATUSES.items()},
        workers={state: states.count(state) for state in WorkerState},
        oldest_waiting_s=0.0 if oldest_ms is None else max(0.0, time.time() - oldest_ms / 1000.0),
    )
