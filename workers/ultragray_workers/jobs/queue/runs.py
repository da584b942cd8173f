"""What was decided about a job, and how long it ran: tables of our own beside DBOS's rows.

A job is published or cancelled, whichever is decided first: a cancellation that comes while its scene is being served
is refused, and a scene whose job is cancelled is never served.
"""

from __future__ import annotations

from datetime import datetime, timezone
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError

from ultragray_workers.jobs.queue.tables import RUNS, USAGE

PUBLISHED, CANCELLED = "published", "cancelled"


def begin(connection: sa.Connection, job_id: str) -> None:
    """The row of a job that is submitted, in place of one that an earlier job of its id left."""
    forget(connection, job_id)
    connection.execute(sa.insert(RUNS).values(job_id=job_id, run_s=0.0))


def forget(connection: sa.Connection, job_id: str) -> None:
    """Removes the row of a job; its time stays in the usage of its owner."""
    connection.execute(sa.delete(RUNS).where(RUNS.c.job_id == job_id))


def decide(engine: sa.Engine, job_id: str, decision: str) -> bool:
    """Whether this is the decision about the job, now or before; False where it was decided otherwise."""
    undecided = sa.or_(RUNS.c.decided.is_(None), RUNS.c.decided == decision)
    changed = sa.update(RUNS).where(RUNS.c.job_id == job_id, undecided).values(decided=decision)
    return _update_or_insert(engine, changed, sa.insert(RUNS).values(job_id=job_id, decided=decision, run_s=0.0))


def run_s(engine: sa.Engine, job_id: str) -> float:
    """How long the processes of a job have run until now."""
    with engine.connect() as connection:
        return connection.execute(sa.select(RUNS.c.run_s).where(RUNS.c.job_id == job_id)).scalar() or 0.0


def add_run(engine: sa.Engine, job_id: str, owner: str | None, device: str, seconds: float) -> None:
    """Counts time that a job's process ran, for the job and for its owner."""
    of_job = sa.update(RUNS).where(RUNS.c.job_id == job_id).values(run_s=RUNS.c.run_s + seconds)
    _update_or_insert(engine, of_job, sa.insert(RUNS).values(job_id=job_id, run_s=seconds))
    key: dict[str, Any] = {
        "owner": owner or "",
        "device": "cpu" if device == "cpu" else "gpu",
        "day": datetime.now(timezone.utc).date(),
    }
    same = [USAGE.c[name] == value for name, value in key.items()]
    of_owner = sa.update(USAGE).where(*same).values(run_s=USAGE.c.run_s + seconds)
    _update_or_insert(engine, of_owner, sa.insert(USAGE).values(**key, run_s=seconds))


def usage_s(engine: sa.Engine, owner: str | None, since: datetime) -> dict[str, float]:
    """Seconds that the jobs of an owner ran since the day of `since` (UTC), by device: cpu, gpu."""
    chosen = sa.and_(USAGE.c.owner == (owner or ""), USAGE.c.day >= since.astimezone(timezone.utc).date())
    summed = sa.select(USAGE.c.device, sa.func.sum(USAGE.c.run_s)).where(chosen).group_by(USAGE.c.device)
    with engine.connect() as connection:
        return {"cpu": 0.0, "gpu": 0.0} | {row[0]: row[1] for row in connection.execute(summed)}


def _update_or_insert(engine: sa.Engine, update: sa.Update, insert: sa.Insert) -> bool:
    """Whether a row was changed or made; False where there is one that the update does not apply to."""
    with engine.begin() as connection:
        if connection.execute(update).rowcount:
            return True
    try:
        with engine.begin() as connection:
            connection.execute(insert)
            return True
    except IntegrityError:  # the row is there, or another process has just made it
        with engine.begin() as connection:
            return bool(connection.execute(update).rowcount)
