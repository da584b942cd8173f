"""The table of shards: which of a batch are done, and who is at the others. Free of torch."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.tables import JOBS, SHARDS

MOST_TRIES = 20  # of one shard: after so many deaths of those who were at it, it is to blame
_ROWS = SHARDS.c


@dataclass(frozen=True)
class Tally:
    """The shards of a batch in numbers."""

    shards: int = 0
    free: int = 0  # nobody is at them
    done: int = 0
    frames_done: int = 0


@dataclass(frozen=True)
class Failed:
    """A shard that cannot be made, and why."""

    number: int
    error: str  # stable reason
    reason: str  # one sentence


def lay_out(engine: sa.Engine, batch: str, frames: int, shard_frames: int, done: Collection[int]) -> None:
    """Makes the rows of a batch, those that are `done` already included; nothing where they are there."""
    with engine.begin() as connection:
        if connection.execute(sa.select(_ROWS.number).where(_ROWS.job == batch).limit(1)).first() is not None:
            return
        rows = [
            {
                "job": batch,
                "number": number,
                "frames": min(shard_frames, frames - number * shard_frames),
                "done": number in done,
                "tries": 0,
            }
            for number in range(-(-frames // shard_frames))
        ]
        connection.execute(sa.insert(SHARDS), rows)


def take(engine: sa.Engine, batch: str, share: str) -> int | None:
    """The next free shard, which is the share's now; None where there is none."""
    others = SHARDS.alias()
    free = (
        sa.select(others.c.number)
        .where(others.c.job == batch, *_is_free(others.c))
        .order_by(others.c.number)
        .limit(1)
        .with_for_update(skip_locked=True)
    )
    # One statement: a SQLite file is locked from a change on, not from the question before it.
    taking = (
        sa.update(SHARDS)
        .where(_ROWS.job == batch, _ROWS.number == free.scalar_subquery(), _ROWS.share.is_(None))
        .values(share=share, tries=_ROWS.tries + 1)
        .returning(_ROWS.number)
    )
    with engine.begin() as connection:
        return connection.execute(taking).scalar()


def complete(engine: sa.Engine, batch: str, number: int) -> None:
    """Says that a shard is there, whoever made it."""
    with engine.begin() as connection:
        connection.execute(_of(batch, number).values(done=True, share=None, error=None, reason=None))


def fail(engine: sa.Engine, batch: str, failed: Failed) -> None:
    """Says that a shard cannot be made, unless it was."""
    with engine.begin() as connection:
        values = {"share": None, "error": failed.error, "reason": failed.reason}
        connection.execute(_of(batch, failed.number).where(_ROWS.done.is_(False)).values(values))


def failed(engine: sa.Engine, batch: str) -> Failed | None:
    """The first shard that cannot be made; None where there is none."""
    is_lost = sa.and_(_ROWS.share.is_(None), _ROWS.tries >= MOST_TRIES)
    found = (
        sa.select(_ROWS.number, _ROWS.error, _ROWS.reason)
        .where(_ROWS.job == batch, _ROWS.done.is_(False), sa.or_(_ROWS.error.is_not(None), is_lost))
        .order_by(_ROWS.number)
        .limit(1)
    )
    with engine.connect() as connection:
        row = connection.execute(found).one_or_none()
    if row is None:
        return None
    why = row.reason or f"its process or worker died {MOST_TRIES} times"
    return Failed(row.number, row.error or "INTERNAL", why)


def release(engine: sa.Engine, batch: str, share: str) -> None:
    """Frees the shards of a share whose process has ended."""
    with engine.begin() as connection:
        mine = sa.and_(_ROWS.job == batch, _ROWS.share == share)
        connection.execute(sa.update(SHARDS).where(mine).values(share=None))


def release_lost(engine: sa.Engine, batch: str) -> None:
    """Frees the shards of shares that nobody runs any more."""
    running = sa.select(JOBS.c.id).where(JOBS.c.id == _ROWS.share, JOBS.c.state == JobState.RUNNING.value)
    lost = sa.and_(_ROWS.job == batch, _ROWS.share.is_not(None), ~running.exists())
    with engine.begin() as connection:
        connection.execute(sa.update(SHARDS).where(lost).values(share=None))


def tally(engine: sa.Engine, batch: str) -> Tally:
    """The shards as they are now."""
    done = sa.case((_ROWS.done, 1), else_=0)
    free = sa.case((sa.and_(*_is_free(_ROWS)), 1), else_=0)
    counted = sa.select(
        sa.func.count(),
        sa.func.coalesce(sa.func.sum(free), 0),
        sa.func.coalesce(sa.func.sum(done), 0),
        sa.func.coalesce(sa.func.sum(done * _ROWS.frames), 0),
    ).where(_ROWS.job == batch)
    with engine.connect() as connection:
        return Tally(*(int(value) for value in connection.execute(counted).one()))


def _is_free(row: Any) -> tuple[sa.ColumnElement[bool], ...]:
    return row.done.is_(False), row.share.is_(None), row.error.is_(None), row.tries < MOST_TRIES


def _of(batch: str, number: int) -> sa.Update:
    return sa.update(SHARDS).where(_ROWS.job == batch, _ROWS.number == number)
