"""Render jobs in shards: the queue as an engine of batches.

The job that was submitted is the batch: it lays out a row for each shard, works at them itself, and writes the manifest
when all are done. While shards are free, one *share* of the batch waits in the queue, a task that users do not see: the
worker that takes it puts the next one behind it, and works at the shards, too. So all workers that have nothing else to
do come to help, one at a time, and each keeps the scene loaded between shards. Which shard is whose stands in a table,
which the processes of the batch and of its shares ask themselves: of one that dies, only what it had at hand is
rendered again. Free of torch.
"""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from threading import Event
from typing import Any, NamedTuple, TypeVar

import sqlalchemy as sa
from sqlalchemy.exc import OperationalError

from ultragray_workers.errors import DatabaseUnavailable, StartupFailed, StorageFull
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.progress import JobState, Outcome
from ultragray_workers.jobs.tables import JOBS, SHARDS
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped
from ultragray_workers.jobs.worker.process import DATABASE_VARIABLE
from ultragray_workers.storage.storage import Storage

MOST_TRIES = 20  # of one shard: after so many deaths of those who were at it, it is to blame
_AWAY = (DatabaseUnavailable, StartupFailed, StorageFull, OperationalError)
_LOOK_EVERY_S, _POLL_S = 1.0, 0.2
_ASK_AGAIN_S = 0.5  # while others are at the last shards, or the database is away
_ROWS = SHARDS.c
_T = TypeVar("_T")


class BatchFailed(Exception):
    """A shard cannot be made, by whomever it was tried: the stable reason of the error, and one sentence."""

    def __init__(self, error: str, reason: str) -> None:
        super().__init__(reason)
        self.error, self.reason = error, reason


class ShardQueue:
    """The shards that the process of a batch makes, or of a share of it, during the body.

    Threads ask the database, for the next shard ahead, so that rendering never waits for it.
    """

    def __init__(self, job_run: JobRun, storage: Storage) -> None:
        """Raises Stopped where the worker stops while the database is away."""
        request, folder = job_run.request, job_run.folder
        self._share, self._batch = folder.job_id, request.batch or folder.job_id
        self._is_batch = request.batch is None
        self._leaves_at_s = time.monotonic() + request.longest_share_s
        self._should_stop, self._is_left = job_run.should_stop, Event()
        self._threads = ThreadPoolExecutor(2, "shards")
        self._ahead: Future[int | None] | None = None
        self._looking: Future[None] | None = None
        self._looked_at_s = float("-inf")
        self.frames_done: int | None = None  # of the whole batch; None: not known yet
        url = os.environ[DATABASE_VARIABLE]
        self._database = self._patiently(lambda: JobDatabase(folder.artifact_folder, url, storage))
        mine = sa.and_(_ROWS.job == self._batch, _ROWS.share == self._share)  # of a process that died
        self._change(sa.update(SHARDS).where(mine).values(share=None))

    def __enter__(self) -> ShardQueue:
        return self

    def __exit__(self, *exception: object) -> None:
        self._is_left.set()
        self._threads.shutdown()
        self._database.close()

    def lay_out(self, frames: int, shard_frames: int, done: Collection[int]) -> None:
        """Makes the rows of the batch, those that are `done` already included. Raises Stopped."""
        whole = set(done)
        rows = [
            {
                "job": self._batch,
                "number": number,
                "frames": min(shard_frames, frames - number * shard_frames),
                "done": number in whole,
                "tries": 0,
            }
            for number in range(-(-frames // shard_frames))
        ]

        def insert() -> None:
            with self._database.engine.begin() as connection:
                there = sa.select(_ROWS.number).where(_ROWS.job == self._batch).limit(1)
                if connection.execute(there).first() is None:
                    connection.execute(sa.insert(SHARDS), rows)

        self._patiently(insert)

    def take(self, meanwhile: Callable[[], None]) -> int | None:
        """The next shard; None where this process is not needed any more.

        `meanwhile` is called while there is nothing to do; to stop, it raises. Raises BatchFailed, Stopped.
        """
        found = self._ahead or self._threads.submit(self._take)
        while not found.done():
            meanwhile()
            wait([found], _POLL_S)
        shard = found.result()
        self._ahead = None if shard is None else self._threads.submit(self._take)
        return shard

    def done(self, shard: int) -> None:
        """Says that a shard is in its place. Raises Stopped."""
        made = sa.update(SHARDS).where(_ROWS.job == self._batch, _ROWS.number == shard)
        self._change(made.values(done=True, share=None, error=None, reason=None))

    def look(self) -> None:
        """Lets a thread count the frames that are done, and call for help where shards are free: once a second."""
        if time.monotonic() - self._looked_at_s < _LOOK_EVERY_S or (self._looking and not self._looking.done()):
            return
        if self._looking is not None:
            self._looking.result()
        self._looked_at_s = time.monotonic()
        self._looking = self._threads.submit(self._look)

    def _look(self) -> None:
        with suppress(*_AWAY):
            counted = self._tally()
            self.frames_done = counted.frames_done
            if counted.free:
                queue.add_share(self._database.engine, self._batch, f"{self._batch}-{uuid.uuid4().hex[:8]}")

    def _take(self) -> int | None:
        while True:
            shard, is_over = self._patiently(self._next)
            if shard is not None or is_over:
                return shard
            self._pause()

    def _next(self) -> tuple[int | None, bool]:
        """The next shard that is free, and whether there will be none any more for this process."""
        self._raise_failure()
        has_worked = time.monotonic() > self._leaves_at_s
        if not self._is_batch and has_worked and queue.count_waiting(self._database.engine):
            return None, True  # other jobs have their turn: the next share waits behind them
        shard = self._take_free()
        if shard is None and self._is_batch:
            self._free_lost()
            shard = self._take_free()
        if shard is not None:
            return shard, False
        counted = self._tally()
        return None, not self._is_batch or counted.done == counted.shards

    def _raise_failure(self) -> None:
        """Raises BatchFailed for the first shard that cannot be made, where there is one."""
        is_lost = sa.and_(_ROWS.share.is_(None), _ROWS.tries >= MOST_TRIES)
        found = (
            sa.select(_ROWS.error, _ROWS.reason)
            .where(_ROWS.job == self._batch, ~_ROWS.done, sa.or_(_ROWS.error.is_not(None), is_lost))
            .order_by(_ROWS.number)
            .limit(1)
        )
        with self._database.engine.connect() as connection:
            row = connection.execute(found).one_or_none()
        if row is not None:
            why = row.reason or f"its process or worker died {MOST_TRIES} times"
            raise BatchFailed(row.error or "INTERNAL", why)

    def _take_free(self) -> int | None:
        others = SHARDS.alias()
        free = (
            sa.select(others.c.number)
            .where(others.c.job == self._batch, *_is_free(others.c))
            .order_by(others.c.number)
            .limit(1)
            .with_for_update(skip_locked=True)
        )
        # One statement: a SQLite file is locked from a change on, not from the question before it.
        taking = (
            sa.update(SHARDS)
            .where(_ROWS.job == self._batch, _ROWS.number == free.scalar_subquery(), _ROWS.share.is_(None))
            .values(share=self._share, tries=_ROWS.tries + 1)
            .returning(_ROWS.number)
        )
        with self._database.engine.begin() as connection:
            return connection.execute(taking).scalar()

    def _free_lost(self) -> None:
        """Frees the shards of shares that nobody runs any more."""
        running = sa.select(JOBS.c.id).where(JOBS.c.id == _ROWS.share, JOBS.c.state == JobState.RUNNING.value)
        lost = sa.and_(_ROWS.job == self._batch, _ROWS.share.is_not(None), ~running.exists())
        self._change(sa.update(SHARDS).where(lost).values(share=None))

    def _tally(self) -> _Tally:
        done = sa.case((_ROWS.done, 1), else_=0)
        free = sa.case((sa.and_(*_is_free(_ROWS)), 1), else_=0)
        counted = sa.select(
            sa.func.count(), *(sa.func.coalesce(sa.func.sum(one), 0) for one in (free, done, done * _ROWS.frames))
        ).where(_ROWS.job == self._batch)
        with self._database.engine.connect() as connection:
            return _Tally(*(int(value) for value in connection.execute(counted).one()))

    def _change(self, update: sa.Update) -> None:
        def change() -> None:
            with self._database.engine.begin() as connection:
                connection.execute(update)

        self._patiently(change)

    def _patiently(self, question: Callable[[], _T]) -> _T:
        """The answer of a database that may be away for a while. Raises Stopped."""
        while True:
            try:
                return question()
            except _AWAY:
                self._pause()

    def _pause(self) -> None:
        if self._is_left.wait(_ASK_AGAIN_S) or self._should_stop():
            raise Stopped


class _Tally(NamedTuple):
    """The shards of a batch, how many of them are free and done, and the frames of the latter."""

    shards: int
    free: int  # nobody is at them
    done: int
    frames_done: int


def blame(engine: sa.Engine, batch: str, share: str, outcome: Outcome) -> None:
    """Blames the first shard that a share had at hand for the end of its work; nothing where it had none."""
    at_hand = sa.select(sa.func.min(_ROWS.number)).where(_ROWS.job == batch, _ROWS.share == share, ~_ROWS.done)
    values = {"share": None, "error": outcome.error, "reason": outcome.reason or outcome.error}
    with engine.begin() as connection:
        number = connection.execute(at_hand).scalar()
        connection.execute(sa.update(SHARDS).where(_ROWS.job == batch, _ROWS.number == number).values(values))


def _is_free(row: Any) -> tuple[sa.ColumnElement[bool], ...]:
    return ~row.done, row.share.is_(None), row.error.is_(None), row.tries < MOST_TRIES
