"""The workers as administrators see them, and what they want of them, by the table into which the workers beat."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone
from enum import Enum

import sqlalchemy as sa

from ultragray.contract import described
from ultragray_workers.errors import WorkerNotFound, known_names
from ultragray_workers.jobs.matching.offer import LivingWorker, WorkerDevice, offer_of_json
from ultragray_workers.jobs.queue.database import JobDatabase
from ultragray_workers.jobs.queue.heartbeat import DEAD_AFTER_S, now_s
from ultragray_workers.jobs.queue.tables import WORKERS
from ultragray_workers.jobs.queue.wishes import Wanted, wanted_of


class WorkerState(str, Enum):
    """The state of a worker."""

    IDLE = "idle"
    WORKING = "working"
    PAUSING = "pausing"
    PAUSED = "paused"
    DRAINING = "draining"
    DRAINED = "drained"
    LOST = "lost"


_STATES = {  # by what is wanted, and whether there is a job at hand
    (Wanted.WORK, False): WorkerState.IDLE,
    (Wanted.WORK, True): WorkerState.WORKING,
    (Wanted.PAUSE, False): WorkerState.PAUSED,
    (Wanted.PAUSE, True): WorkerState.PAUSING,
    (Wanted.DRAIN, False): WorkerState.DRAINED,
    (Wanted.DRAIN, True): WorkerState.DRAINING,
}


@dataclass(frozen=True, kw_only=True)
class Worker:
    """A worker of the queue."""

    name: str
    state: WorkerState = described("lost: it has given no sign of life for 10 s, or was stopped while paused.")
    host: str
    pid: int
    device: str = described("As it was started with: auto, cpu, cuda or cuda:N.")
    devices: tuple[WorkerDevice, ...] = described("Those that it does jobs on, the preferred one first.")
    labels: dict[str, str] = described("Those that jobs can ask for.")
    version: str = described("Of its release.")
    started_at: str | None = described("ISO 8601, UTC.")
    seconds_since_beat: float | None = described("Since its last sign of life; null: it was stopped.")
    job: str | None = described("The job at hand; null: none, or one that is private to somebody else.")


def list_workers(jobs: JobDatabase) -> list[Worker]:
    """The workers that live, are wanted to rest, or were lost within a day, by name."""
    age_s = now_s(jobs) - WORKERS.c.seen_at_s
    with jobs.engine.begin() as connection:
        rows = connection.execute(sa.select(WORKERS, age_s.label("age_s")).order_by(WORKERS.c.executor)).all()
    return [_worker_of(row) for row in rows]


def living_workers(jobs: JobDatabase) -> list[LivingWorker]:
    """The workers that give signs of life, by name."""
    is_alive = WORKERS.c.seen_at_s > now_s(jobs) - DEAD_AFTER_S
    found = sa.select(WORKERS.c.executor, WORKERS.c.offer, WORKERS.c.wanted).where(is_alive)
    with jobs.engine.connect() as connection:
        return [
            LivingWorker(row.executor, offer_of_json(row.offer), wanted_of(row.wanted) is not Wanted.WORK)
            for row in connection.execute(found.order_by(WORKERS.c.executor))
        ]


def want(jobs: JobDatabase, name: str, wanted: Wanted) -> Worker:
    """Tells a worker what is wanted of it, which it does within a second or two. Raises WorkerNotFound."""
    kept = None if wanted is Wanted.WORK else wanted.value
    with jobs.engine.begin() as connection:
        connection.execute(sa.update(WORKERS).where(WORKERS.c.executor == name).values(wanted=kept))
    workers = {worker.name: worker for worker in list_workers(jobs)}
    if name not in workers:
        known = known_names("worker", list(workers))
        raise WorkerNotFound(f"there is no worker {name[:128]!r}; {known}", field="worker")
    return workers[name]


def _worker_of(row: sa.Row[tuple[object, ...]]) -> Worker:
    facts = row._mapping
    is_lost = facts["age_s"] > DEAD_AFTER_S
    offer = offer_of_json(facts["offer"])
    state = _STATES[wanted_of(facts["wanted"]), facts["job_id"] is not None]
    return Worker(
        name=facts["executor"],
        state=WorkerState.LOST if is_lost else state,
        host=facts["host"] or "",
        pid=facts["pid"] or 0,
        device=facts["device"] or "",
        devices=offer.devices,
        labels=dict(offer.labels),
        version=facts["version"] or "",
        started_at=_iso(facts["started_at_s"]),
        seconds_since_beat=max(0.0, round(facts["age_s"], 1)) if facts["seen_at_s"] else None,
        job=None if is_lost else facts["job_id"],
    )


def _iso(epoch_s: float | None) -> str | None:
    return None if epoch_s is None else datetime.fromtimestamp(epoch_s, timezone.utc).isoformat(timespec="seconds")
