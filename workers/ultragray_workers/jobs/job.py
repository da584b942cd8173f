"""A job as callers see it, and how it follows from its row in the queue."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from enum import Enum
from typing import Any

from dbos import WorkflowStatus

from ultragray.contract import described
from ultragray_workers.jobs.files import JobFiles
from ultragray_workers.jobs.folder import Outcome, Progress
from ultragray_workers.jobs.kinds import KINDS
from ultragray_workers.jobs.matching.demand import Demand
from ultragray_workers.jobs.matching.offer import LivingWorker, waits_for
from ultragray_workers.jobs.queue import database
from ultragray_workers.jobs.queue.owners import Ownership

MAX_PRIORITY = 1000
PRIORITY_ZERO = MAX_PRIORITY + 1  # DBOS takes the lowest number first, from 1


class JobState(str, Enum):
    """The state of a job in its life."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def is_final(self) -> bool:
        """Whether the job neither waits nor runs."""
        return self not in (JobState.QUEUED, JobState.RUNNING)


STATUSES = {
    JobState.QUEUED: database.QUEUED,
    JobState.RUNNING: database.RUNNING,
    JobState.SUCCEEDED: database.SUCCEEDED,
    JobState.FAILED: database.FAILED,
    JobState.CANCELLED: database.CANCELLED,
}
_STATE_OF = {status: state for state, statuses in STATUSES.items() for status in statuses}


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
    owner: str | None = described("Who submitted it; null: from before there were owners.")
    private: bool = described("Whether others may not see it, nor the scene that it makes.")


def job_of_row(row: WorkflowStatus, files: JobFiles, workers: Sequence[LivingWorker]) -> Job:
    """The job of a row of the queue; the files of an unfinished one say how far it is.

    `workers`: those that live; of a job that does not wait, none need be given.
    """
    state = _STATE_OF[row.status]
    outcome, ownership = _outcome(row), ownership_of(row)
    started = state is not JobState.QUEUED or bool(row.recovery_attempts)
    if outcome is None:
        progress = files.progress(row.workflow_id) if started else Progress()
        outcome = Outcome(progress=progress, attempts=row.recovery_attempts or 0)
    assert row.created_at is not None
    return Job(
        id=row.workflow_id,
        kind=row.name,
        state=state,
        request_id=attribute(row, "request_id"),
        specification={name: value for name, value in attribute(row, "specification").items() if name != "kind"},
        priority=PRIORITY_ZERO - (row.priority or 0),
        created_at=_iso(row.created_at),
        started_at=_iso_not_before(row.created_at, row.dequeued_at),
        finished_at=_iso_not_before(max(row.created_at, row.dequeued_at or 0), row.completed_at),
        reason=outcome.reason,
        error=outcome.error,
        progress=replace(outcome.progress, waits_for=_waits_for(row, workers) if state is JobState.QUEUED else None),
        artifacts=outcome.artifacts,
        metrics=outcome.metrics,
        worker=row.executor_id if started else None,
        retry_of=attribute(row, "retry_of"),
        attempts=outcome.attempts,
        owner=ownership.owner,
        private=ownership.private,
    )


def ownership_of(row: WorkflowStatus) -> Ownership:
    """Whose a job is."""
    return Ownership(row.authenticated_user, bool(attribute(row, "private")))


def _waits_for(row: WorkflowStatus, workers: Sequence[LivingWorker]) -> str | None:
    """The need of a job that no worker of this release, or none that lives, can do."""
    version = row.app_version
    if version in (database.VERSION, *database.OLDER_VERSIONS, None):
        return waits_for(Demand.of(attribute(row, "specification")), workers)
    return f"a worker of another release: the job has version {version}, those of this release do {database.VERSION}"


def _outcome(row: WorkflowStatus) -> Outcome | None:
    """The outcome of a finished job, as the queue keeps it."""
    if isinstance(row.output, dict):
        return Outcome.from_dict(row.output)
    if row.error is None:
        return None
    kept = getattr(row.error, "data", None)
    if isinstance(kept, dict):
        return Outcome.from_dict(kept)
    return Outcome(error="INTERNAL", reason=str(row.error) or type(row.error).__name__)


def attribute(row: WorkflowStatus, name: str) -> Any:
    """A value that the store kept with a row at its submission."""
    return (row.attributes or {}).get(name)


def _iso(epoch_ms: int) -> str:
    return datetime.fromtimestamp(epoch_ms / 1000, timezone.utc).isoformat(timespec="milliseconds")


def _iso_not_before(earliest_ms: int, epoch_ms: int | None) -> str | None:
    """DBOS rounds the times of a SQLite file to seconds, before Python 3.12."""
    return None if epoch_ms is None else _iso(max(earliest_ms, epoch_ms))
