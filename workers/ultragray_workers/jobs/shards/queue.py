"""The shards of a batch as the process of a job sees them: its worker hands them out, one after another."""

from __future__ import annotations

import time
from collections.abc import Callable

from ultragray.exchange.batches import BatchPlan
from ultragray_workers.jobs.shards.channel import Channel
from ultragray_workers.jobs.shards.claims import Failed

_POLL_S = 0.2
_ASK_AGAIN_S = 0.5  # while others are at the last shards


class BatchFailed(Exception):
    """Raised where a shard cannot be made, by whomever it was tried."""

    def __init__(self, failed: Failed) -> None:
        super().__init__(failed.reason)
        self.failed = failed


class ShardQueue:
    """Shards to make. One is asked for ahead, so that rendering never waits for the database."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._next: list[int] = []
        self._is_asked = self._is_over = self._must_wait = False
        self._failed: Failed | None = None
        self.frames_done: int | None = None  # of the whole batch; None: not known yet

    def lay_out(self, plan: BatchPlan, done: list[int]) -> None:
        """Says what the batch is, and which of its shards are there already."""
        self._channel.send({"plan": {"frames": plan.frames, "shard_frames": plan.shard_frames, "done": done}})

    def take(self, meanwhile: Callable[[], None]) -> int | None:
        """The next shard; None where this process is not needed any more.

        `meanwhile` is called while there is nothing to do; to stop, it raises. Raises BatchFailed.
        """
        self._ask()
        while not self._next and not self._is_over:
            self.look(_POLL_S)
            meanwhile()
            if self._must_wait:
                time.sleep(_ASK_AGAIN_S)
                self._must_wait = False
                self._ask()
        if not self._next:
            return None
        shard = self._next.pop()
        self._ask()
        return shard

    def done(self, shard: int) -> None:
        """Says that a shard is in its place."""
        self._channel.send({"done": shard})

    def look(self, timeout_s: float = 0.0) -> None:
        """Hears what the worker has said. Raises BatchFailed."""
        for message in self._channel.receive(timeout_s):
            if "frames_done" in message:
                self.frames_done = message["frames_done"]
                continue
            self._is_asked = False
            if "failed" in message:
                self._failed = Failed(**message["failed"])
            elif message["shard"] is not None:
                self._next.append(message["shard"])
            elif message["end"]:
                self._is_over = True
            else:
                self._must_wait = True
        if self._failed is not None:
            raise BatchFailed(self._failed)

    def _ask(self) -> None:
        if not self._is_asked and not self._is_over and not self._next:
            self._is_asked = True
            self._channel.send({"take": True})
