"""The record of a job: its row in the table `jobs`, and the job as callers see it.

A job waits (queued), is done by a worker (running), and ends (succeeded, failed or cancelled). `jobs.queue` has every
change of a row. Free of torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from datetime import datetime, timezone
from typing import Any

import sqlalchemy as sa

from ultragray.contract import described, made_of
from ultragray_workers.jobs.demand import LivingWorker, demand_of_key, waits_for
from ultragray_workers.jobs.kinds import KINDS
from ultragray_workers.jobs.owners import Ownership
from ultragray_workers.jobs.progress import Files, JobState, Outcome, Progress
from ultragray_workers.jobs.tables import JOBS

MAX_PRIORITY = 1000


@dataclass(frozen=True)
class Row:
    """The columns of a job that are read together; the whole specification is read apart: it may hold many poses."""

    number: int
    id: str
    kind: str
    state: JobState
    priority: int
    owner: str | None
    private: bool
    request_id: str | None
    asked: str
    retry_of: str | None
    batch: str | None
    summary: dict[str, Any]
    demand: str
    trace: dict[str, str]
    created_ms: int
    worker: str | None
    attempt: int
    started_ms: int | None
    run_s: float
    progress: Progress | None
    files: Files
    published: bool
    outcome: Outcome | None
    finished_ms: int | None
    makes_scene: str | None
    most_running: int | None

    @property
    def ownership(self) -> Ownership:
        return Ownership(self.owner, self.private)

    @classmethod
    def of(cls, row: sa.Row[Any]) -> Row:
        values = dict(row._mapping)
        return cls(**{**values, "state": JobState(values["state"]), "files": values["files"] or Files()})


COLUMNS = tuple(JOBS.c[item.name] for item in fields(Row))


@dataclass(frozen=True, kw_only=True)
class Job:
    """A job as it is now."""

    id: str
    kind: str = described("What is done.", choices=KINDS)
    state: JobState
    request_id: str | None
    specification: dict[str, Any] = described("As it was sent; of poses only their number, as pose_count.")
    priority: int
    created_at: str = described("ISO 8601, UTC; likewise the other times.")
    started_at: str | None = described("The last time.")
    finished_at: str | None
    reason: str | None = described("Why it failed: one sentence.")
    error: str | None = described("Why it failed: the stable reason, such as DATASET_INVALID.")
    progress: Progress
    artifacts: tuple[str, ...] = described("Names of files to download; frames-{000000..000199}.tar stands for 200.")
    metrics: dict[str, float] = described("Of a scene on the held-out frames.")
    worker: str | None
    retry_of: str | None = described("The job that this one goes on from.")
    attempts: int = described("How often it was started.")
    owner: str | None = described("Who submitted it; null: nobody who is known.")
    private: bool = described("Whether others may not see it, nor the scene that it makes.")


def job_of(row: Row, workers: Sequence[LivingWorker]) -> Job:
    """The job of a row. `workers`: those that live; of a job that does not wait, none need be given."""
    outcome = row.outcome if row.state.is_final else None
    if outcome is None:
        outcome = Outcome(progress=row.progress or Progress(), attempts=row.attempt)
    waits = waits_for(demand_of_key(row.demand), workers) if row.state is JobState.QUEUED else None
    return made_of(
        Job,
        row,
        outcome,
        specification={name: value for name, value in row.summary.items() if name != "kind"},
        created_at=_iso(row.created_ms),
        started_at=None if row.started_ms is None else _iso(max(row.created_ms, row.started_ms)),
        finished_at=None if row.finished_ms is None else _iso(max(row.started_ms or row.created_ms, row.finished_ms)),
        progress=replace(outcome.progress, waits_for=waits),
        worker=row.worker if row.attempt else None,
    )


def _iso(epoch_ms: int) -> str:
    return datetime.fromtimestamp(epoch_ms / 1000, timezone.utc).isoformat(timespec="milliseconds")
