"""The process of a batch and its worker: the pipe between them, and the shards that the worker hands out over it.

Messages are JSON, one a line. The worker's side is `shards.desk`.
"""

from __future__ import annotations

import json
import os
import select
import time
from collections.abc import Callable, Iterator
from typing import Any

from ultragray.exchange.batches import BatchPlan
from ultragray_workers.jobs.shards.table import Failed

_CHUNK_BYTES = 1 << 16
_POLL_S = 0.2
_ASK_AGAIN_S = 0.5  # while others are at the last shards


class Channel:
    """One end: a pipe that is read, and one that is written."""

    def __init__(self, reading: int, writing: int) -> None:
        self._reading, self._writing = reading, writing
        self._begun = b""  # of a line
        self.is_open = True  # the other end may still say something

    def send(self, message: dict[str, Any]) -> None:
        """Says something; nothing where the other end has gone."""
        data = json.dumps(message).encode() + b"\n"
        try:
            while data:
                data = data[os.write(self._writing, data) :]
        except BrokenPipeError:
            self.is_open = False

    def receive(self, timeout_s: float) -> Iterator[dict[str, Any]]:
        """What the other end has said; waits until it says something, or for so long."""
        if not self.is_open or not select.select([self._reading], [], [], timeout_s)[0]:
            return
        data = os.read(self._reading, _CHUNK_BYTES)
        self.is_open = bool(data)
        *lines, self._begun = (self._begun + data).split(b"\n")
        for line in lines:
            yield json.loads(line)

    def close(self) -> None:
        """Ends this end."""
        self.is_open = False
        for descriptor in (self._reading, self._writing):
            os.close(descriptor)


def channel() -> tuple[Channel, tuple[int, int]]:
    """An end for this process, and the descriptors for the end of another one, which inherits them."""
    there_reads, here_writes = os.pipe()
    here_reads, there_writes = os.pipe()
    return Channel(here_reads, here_writes), (there_reads, there_writes)


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
