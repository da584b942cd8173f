"""The jobs of a database in numbers, for those who watch a service."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from ultragray_workers.jobs.job import STATUSES, JobState
from ultragray_workers.jobs.matching.demand import AUTO, CPU, CUDA
from ultragray_workers.jobs.matching.offer import waits_for
from ultragray_workers.jobs.queue import unfinished
from ultragray_workers.jobs.queue.attendance import WorkerState, list_workers, living_workers
from ultragray_workers.jobs.queue.database import JobDatabase
from ultragray_workers.jobs.queue.listing import count_by_status


@dataclass(frozen=True)
class JobsOverview:
    """How many jobs and workers there are in each state, and which jobs wait. Empty where it is not known."""

    counts: Mapping[JobState, int] = field(default_factory=dict)
    workers: Mapping[WorkerState, int] = field(default_factory=dict)
    # By the device that jobs ask for (auto, cpu, cuda): how long the one has waited that waits longest; 0: none waits.
    oldest_waiting_s: Mapping[str, float] = field(default_factory=dict)
    unfit: int = 0  # jobs that wait for a worker that is not there


def overview(jobs: JobDatabase) -> JobsOverview:
    """The jobs as they are now. Raises DatabaseUnavailable."""
    found = count_by_status(jobs)
    states = [worker.state for worker in list_workers(jobs)]
    oldest_s, unfit, now_s = dict.fromkeys((AUTO, CPU, CUDA), 0.0), 0, time.time()
    living = living_workers(jobs)
    for demand, count, oldest_ms in unfinished.waiting(jobs):
        kind = demand.device.partition(":")[0]
        oldest_s[kind] = max(oldest_s[kind], now_s - oldest_ms / 1000.0)
        unfit += count if waits_for(demand, living) is not None else 0
    return JobsOverview(
        counts={state: sum(found.get(status, 0) for status in statuses) for state, statuses in STATUSES.items()},
        workers={state: states.count(state) for state in WorkerState},
        oldest_waiting_s=oldest_s,
        unfit=unfit,
    )
