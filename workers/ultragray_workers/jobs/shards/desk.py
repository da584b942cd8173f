"""The worker's side of a batch: hands out shards to the process of its job, and keeps account of them."""

from __future__ import annotations

import time
import uuid
from collections import deque
from contextlib import suppress
from typing import Any

import sqlalchemy as sa

from ultragray_workers.errors import DatabaseUnavailable, StorageFull
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.progress import Outcome
from ultragray_workers.jobs.record import Row
from ultragray_workers.jobs.shards import table
from ultragray_workers.jobs.shards.channel import channel
from ultragray_workers.jobs.shards.table import Failed

_TELL_INTERVAL_S = 1.0
LONGEST_SHARE_S = 60.0  # then a share ends, where other jobs wait


class BatchOver(Exception):
    """The batch of a share is cancelled, failed or done: its process is not needed any more."""


class ShardDesk:
    """The desk of one process at work at a batch."""

    def __init__(self, engine: sa.Engine, row: Row) -> None:
        """Raises DatabaseUnavailable."""
        self._engine = engine
        self._share, self._batch = row.id, row.batch or row.id
        table.release(engine, self._batch, self._share)
        self._channel, self._there = channel()
        self._heard: deque[dict[str, Any]] = deque()  # and not answered, since the database is away
        self._at_hand: deque[int] = deque()  # handed out, in that order, and not done
        self._told_at_s = float("-inf")
        self._since_s = time.monotonic()

    @property
    def descriptors(self) -> tuple[int, int]:
        """For the process, which inherits them."""
        return self._there

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
            table.release(self._engine, self._batch, self._share)

    def fail(self, outcome: Outcome) -> None:
        """Blames the shard at hand for the end of the work. Raises DatabaseUnavailable."""
        if self._at_hand and outcome.error is not None:
            failed = Failed(self._at_hand[0], outcome.error, outcome.reason or outcome.error)
            table.fail(self._engine, self._batch, failed)

    def close(self) -> None:
        """Ends the pipes."""
        self._channel.close()

    @property
    def _is_batch(self) -> bool:
        return self._share == self._batch

    def _answer(self, message: dict[str, Any]) -> None:
        engine = self._engine
        if "plan" in message:
            plan = message["plan"]
            table.lay_out(engine, self._batch, plan["frames"], plan["shard_frames"], set(plan["done"]))
        elif "done" in message:
            table.complete(engine, self._batch, message["done"])
            with suppress(ValueError):
                self._at_hand.remove(message["done"])
        elif (failed := table.failed(engine, self._batch)) is not None:
            self._channel.send({"failed": vars(failed)})
        else:
            self._hand_out()

    def _hand_out(self) -> None:
        engine = self._engine
        number = None if self._should_yield() else table.take(engine, self._batch, self._share)
        if number is None and self._is_batch:
            table.release_lost(engine, self._batch)
            number = table.take(engine, self._batch, self._share)
        if number is not None:
            self._at_hand.append(number)
            self._channel.send({"shard": number})
            return
        counted = table.tally(engine, self._batch)
        self._channel.send({"shard": None, "end": not self._is_batch or counted.done == counted.shards})

    def _should_yield(self) -> bool:
        """Whether this share leaves its worker to other jobs: the next one waits behind them."""
        has_worked = time.monotonic() - self._since_s > LONGEST_SHARE_S
        return not self._is_batch and has_worked and queue.count_waiting(self._engine) > 0

    def _look_after_batch(self) -> None:
        batch = queue.row_of(self._engine, self._batch)
        if batch is None or batch.state.is_final:
            raise BatchOver
        counted = table.tally(self._engine, self._batch)
        self._channel.send({"frames_done": counted.frames_done})
        if counted.free:
            queue.add_share(self._engine, batch, f"{self._batch}-{uuid.uuid4().hex[:8]}")
