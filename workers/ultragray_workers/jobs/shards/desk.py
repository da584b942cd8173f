"""The worker's side of a batch: hands out shards to the process of its job, and keeps account of them in a table."""

from __future__ import annotations

import time
import uuid
from collections import deque
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from ultragray_workers.errors import DatabaseUnavailable, StorageFull
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.progress import JobState, Outcome
from ultragray_workers.jobs.record import Row
from ultragray_workers.jobs.shards.channel import Channel, Failed
from ultragray_workers.jobs.tables import JOBS, SHARDS

_TELL_INTERVAL_S = 1.0
LONGEST_SHARE_S = 60.0  # then a share ends, where other jobs wait


class BatchOver(Exception):
    """The batch of a share is cancelled, failed or done: its process is not needed any more."""


class ShardDesk:
    def __init__(self, engine: sa.Engine, row: Row) -> None:
        self._engine = engine
        self._share, self._batch = row.id, row.batch or row.id
        release(engine, self._batch, self._share)
        self._channel, self.descriptor = Channel.pair()  # the latter for the process, which inherits it
        self._heard: deque[dict[str, Any]] = deque()  # and not answered, since the database is away
        self._at_hand: deque[int] = deque()  # handed out, in that order, and not done
        self._told_at_s = float("-inf")
        self._since_s = time.monotonic()

    def attend(self, timeout_s: float) -> None:
        """Answers what the process says within a time. Raises BatchOver."""
        if self._channel.is_open:
            self._heard.extend(self._channel.receive(timeout_s))
        else:
            time.sleep(timeout_s)
        with suppress(DatabaseUnavailable, StorageFull):  # answered when the database is back
            while self._heard:
                self._answer(self._heard[0])
                self._heard.popleft()
            if time.monotonic() - self._told_at_s >= _TELL_INTERVAL_S:
                self._told_at_s = time.monotonic()
                self._look_after_batch()

    def settle(self) -> None:
        """Hears the last words of a process that has ended, and frees what it leaves. Raises BatchOver."""
        while self._channel.is_open:
            self._heard.extend(self._channel.receive(0.0))
        self.attend(0.0)
        with suppress(DatabaseUnavailable, StorageFull):  # then the batch frees it
            release(self._engine, self._batch, self._share)

    def fail(self, outcome: Outcome) -> None:
        """Blames the shard at hand for the end of the work. Raises DatabaseUnavailable."""
        if self._at_hand and outcome.error is not None:
            failed = Failed(self._at_hand[0], outcome.error, outcome.reason or outcome.error)
            blame(self._engine, self._batch, failed)

    def close(self) -> None:
        self._channel.close()

    @property
    def _is_batch(self) -> bool:
        return self._share == self._batch

    def _answer(self, message: dict[str, Any]) -> None:
        engine = self._engine
        if "plan" in message:
            plan = message["plan"]
            lay_out(engine, self._batch, plan["frames"], plan["shard_frames"], set(plan["done"]))
        elif "done" in message:
            complete(engine, self._batch, message["done"])
            with suppress(ValueError):
                self._at_hand.remove(message["done"])
        elif (failed := first_failure(engine, self._batch)) is not None:
            self._channel.send({"failed": vars(failed)})
        else:
            self._hand_out()

    def _hand_out(self) -> None:
        engine = self._engine
        number = None if self._should_yield() else take(engine, self._batch, self._share)
        if number is None and self._is_batch:
            release_lost(engine, self._batch)
            number = take(engine, self._batch, self._share)
        if number is not None:
            self._at_hand.append(number)
            self._channel.send({"shard": number})
            return
        counted = tally(engine, self._batch)
        self._channel.send({"shard": None, "end": not self._is_batch or counted.done == counted.shards})

    def _should_yield(self) -> bool:
        """Whether this share leaves its worker to other jobs: the next one waits behind them."""
        has_worked = time.monotonic() - self._since_s > LONGEST_SHARE_S
        return not self._is_batch and has_worked and queue.count_waiting(self._engine) > 0

    def _look_after_batch(self) -> None:
        batch = queue.row_of(self._engine, self._batch)
        if batch is None or batch.state.is_final:
            raise BatchOver
        counted = tally(self._engine, self._batch)
        self._channel.send({"frames_done": counted.frames_done})
        if counted.free:
            queue.add_share(self._engine, batch, f"{self._batch}-{uuid.uuid4().hex[:8]}")


# The table of shards: which of a batch are done, and who is at the others.

MOST_TRIES = 20  # of one shard: after so many deaths of those who were at it, it is to blame
_ROWS = SHARDS.c


@dataclass(frozen=True)
class Tally:
    shards: int = 0
    free: int = 0  # nobody is at them
    done: int = 0
    frames_done: int = 0


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
    with engine.begin() as connection:
        connection.execute(_of(batch, number).values(done=True, share=None, error=None, reason=None))


def blame(engine: sa.Engine, batch: str, failed: Failed) -> None:
    with engine.begin() as connection:
        values = {"share": None, "error": failed.error, "reason": failed.reason}
        connection.execute(_of(batch, failed.number).where(_ROWS.done.is_(False)).values(values))


def first_failure(engine: sa.Engine, batch: str) -> Failed | None:
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
