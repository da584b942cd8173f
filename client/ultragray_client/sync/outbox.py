"""Poses on their way out, between the thread that sends them and that of the connection."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator

from ultragray_proto.v1 import rendering_pb2

_MAX_WAITING = 64


class Outbox:
    """A bounded queue: an ordered one makes the sender wait, one that `replaces` keeps the newest message alone."""

    def __init__(self, opening: rendering_pb2.RenderStreamRequest, *, replaces: bool) -> None:
        self._waiting: deque[rendering_pb2.RenderStreamRequest] = deque([opening])
        self._opening = opening
        self._replaces = replaces
        self._changed = threading.Condition()
        self._closed = False
        self._replaced = 0

    def put(self, message: rendering_pb2.RenderStreamRequest) -> bool:
        """Whether it was taken: not by a closed outbox."""
        with self._changed:
            while not self._closed and not self._replaces and len(self._waiting) >= _MAX_WAITING:
                self._changed.wait()
            if self._closed:
                return False
            if self._replaces and self._waiting and self._waiting[-1] is not self._opening:
                self._waiting.pop()
                self._replaced += 1
            self._waiting.append(message)
            self._changed.notify_all()
            return True

    def close(self) -> None:
        """What waits still goes out; nothing more is taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def take_replaced(self) -> int:
        """How many were replaced since this was asked last."""
        with self._changed:
            replaced, self._replaced = self._replaced, 0
            return replaced

    def __iter__(self) -> Iterator[rendering_pb2.RenderStreamRequest]:
        while True:
            with self._changed:
                while not self._waiting and not self._closed:
                    self._changed.wait()
                if not self._waiting:
                    return
                message = self._waiting.popleft()
                self._changed.notify_all()
            yield message
