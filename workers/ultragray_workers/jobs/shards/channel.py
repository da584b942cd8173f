"""The pipe between the process of a batch and its worker, and the side of the process; the other is `shards.desk`."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

from ultragray.exchange.batches import BatchPlan

_POLL_S = 0.2
_ASK_AGAIN_S = 0.5  # while others are at the last shards


@dataclass(frozen=True)
class Failed:
    """A shard that cannot be made, and why."""

    number: int
    error: str  # stable reason
    reason: str  # one sentence


class Channel:
    """One end of a pipe; messages are JSON."""

    def __init__(self, descriptor: int) -> None:
        self._pipe = Connection(descriptor)
        self.is_open = True  # the other end may still say something

    @classmethod
    def pair(cls) -> tuple[Channel, int]:
        """An end for this process, and the descriptor for the end of another one, which inherits it."""
        here, there = Pipe()
        with here, there:
            return cls(os.dup(here.fileno())), os.dup(there.fileno())

    def send(self, message: dict[str, Any]) -> None:
        """Says something; nothing where the other end has gone."""
        try:
            self._pipe.send_bytes(json.dumps(message).encode())
        except ConnectionError:
            self.is_open = False

    def receive(self, timeout_s: float) -> Iterator[dict[str, Any]]:
        """What the other end has said; waits until it says something, or for so long."""
        try:
            while self.is_open and self._pipe.poll(timeout_s):
                yield json.loads(self._pipe.recv_bytes())
                timeout_s = 0.0
        except (EOFError, ConnectionError):
            self.is_open = False

    def close(self) -> None:
        self.is_open = False
        self._pipe.close()


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
