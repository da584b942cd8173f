"""The worker's side of a batch: hands out shards to the process of its job, and keeps account of them."""

from __future__ import annotations

import time
from collections import deque
from contextlib import suppress
from typing import Any

from dbos import WorkflowStatus

from ultragray_workers.errors import DatabaseUnavailable, StorageFull
from ultragray_workers.jobs.folder import Outcome
from ultragray_workers.jobs.queue import database, unfinished
from ultragray_workers.jobs.queue.database import JobDatabase
from ultragray_workers.jobs.shards import claims
from ultragray_workers.jobs.shards.channel import channel
from ultragray_workers.jobs.shards.claims import Failed
from ultragray_workers.jobs.shards.shares import SHARE_OF, call_help

_TELL_INTERVAL_S = 1.0
LONGEST_SHARE_S = 60.0  # then a share ends, where other jobs wait


class BatchOver(Exception):
    """The batch of a share is cancelled, failed or done: its process is not needed any more."""


class ShardDesk:
    """The desk of one process at work at a batch."""

    def __init__(self, jobs: JobDatabase, row: WorkflowStatus, request: dict[str, Any]) -> None:
        """Raises DatabaseUnavailable."""
        self._jobs, self._request = jobs, request
        self._share = row.workflow_id
        self._batch = request.get(SHARE_OF) or row.workflow_id
        claims.release(jobs.engine, self._batch, self._share)
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
            claims.release(self._jobs.engine, self._batch, self._share)

    def fail(self, outcome: Outcome) -> None:
        """Blames the shard at hand for the end of the work. Raises DatabaseUnavailable."""
        if self._at_hand and outcome.error is not None:
            failed = Failed(self._at_hand[0], outcome.error, outcome.reason or outcome.error)
            claims.fail(self._jobs.engine, self._batch, failed)

    def close(self) -> None:
        """Ends the pipes."""
        self._channel.close()

    @property
    def _is_batch(self) -> bool:
        return self._share == self._batch

    def _answer(self, message: dict[str, Any]) -> None:
        engine = self._jobs.engine
        if "plan" in message:
            plan = message["plan"]
            claims.lay_out(engine, self._batch, plan["frames"], plan["shard_frames"], set(plan["done"]))
        elif "done" in message:
            claims.complete(engine, self._batch, message["done"])
            with suppress(ValueError):
                self._at_hand.remove(message["done"])
        elif (failed := claims.failed(engine, self._batch)) is not None:
            self._channel.send({"failed": vars(failed)})
        else:
            self._hand_out()

    def _hand_out(self) -> None:
        engine = self._jobs.engine
        number = None if self._should_yield() else claims.take(engine, self._batch, self._share)
        if number is None and self._is_batch:
            claims.release_lost(engine, self._batch)
            number = claims.take(engine, self._batch, self._share)
        if number is not None:
            self._at_hand.append(number)
            self._channel.send({"shard": number})
            return
        counted = claims.tally(engine, self._batch)
        self._channel.send({"shard": None, "end": not self._is_batch or counted.done == counted.shards})

    def _should_yield(self) -> bool:
        """Whether this share leaves its worker to other jobs: the next one waits behind them."""
        has_worked = time.monotonic() - self._since_s > LONGEST_SHARE_S
        return not self._is_batch and has_worked and unfinished.count_waiting(self._jobs) > 0

    def _look_after_batch(self) -> None:
        batch = self._jobs.workflow(self._batch)
        if batch is None or batch.status not in (*database.QUEUED, *database.RUNNING):
            raise BatchOver
        counted = claims.tally(self._jobs.engine, self._batch)
        self._channel.send({"frames_done": counted.frames_done})
        if counted.free:
            call_help(self._jobs, batch, self._request)
