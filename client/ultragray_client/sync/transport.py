"""The channel and the stream of poses under threads; `aio/transport.py` gives the same names to asyncio."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import grpc

from ..calls.connection import CHANNEL_OPTIONS
from ..calls.pose_exchange import TAKES_NO_MORE, PoseExchange, StreamMode
from ..errors import StreamEnded

P = ParamSpec("P")
R = TypeVar("R")

_MAX_WAITING = 64


def open_channel(address: str) -> grpc.Channel:
    """A channel that threads may share."""
    return grpc.insecure_channel(address, options=CHANNEL_OPTIONS)


def run_blocking(function: Callable[P, R], *arguments: P.args, **keywords: P.kwargs) -> R:
    """The result of a function that waits for the disk, called here: the caller's thread may wait."""
    return function(*arguments, **keywords)


class PoseCall:
    """The call of a stream: poses out, frames in. All raise grpc.RpcError where the call failed.

    Poses wait in a bounded queue for the thread of the connection. In an ordered stream a full queue makes the sender
    wait; in a latest one the newest pose takes the place of one that waits.
    """

    def __init__(self, start: Callable[..., Any], exchange: PoseExchange) -> None:
        self._opening = exchange.opening()
        self._replaces = exchange.mode is StreamMode.LATEST
        self._waiting: deque[Any] = deque([self._opening])
        self._changed = threading.Condition()
        self._closed = False
        self._replaced = 0
        self._call = start(self._messages())
        if not self._call.add_callback(self.done_sending):
            self.done_sending()

    def send(self, message: Any) -> None:
        """Raises StreamEnded where no more are taken."""
        with self._changed:
            while not self._closed and not self._replaces and len(self._waiting) >= _MAX_WAITING:
                self._changed.wait()
            if not self._closed:
                if self._replaces and self._waiting and self._waiting[-1] is not self._opening:
                    self._waiting.pop()
                    self._replaced += 1
                self._waiting.append(message)
                self._changed.notify_all()
                return
        if self._call.is_active() or self._call.code() is grpc.StatusCode.OK:
            raise StreamEnded(TAKES_NO_MORE)
        raise self._call  # grpc's calls are their own errors

    def done_sending(self) -> None:
        """Takes no more poses; those that wait still go out."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def receive(self) -> Any:
        """The next answer; None after the last one."""
        return next(self._call, None)

    def take_replaced(self) -> int:
        """The number of poses replaced here since the last call."""
        with self._changed:
            replaced, self._replaced = self._replaced, 0
            return replaced

    def close(self) -> None:
        self.done_sending()
        self._call.cancel()

    def _messages(self) -> Iterator[Any]:
        while True:
            with self._changed:
                while not self._waiting and not self._closed:
                    self._changed.wait()
                if not self._waiting:
                    return
                message = self._waiting.popleft()
                self._changed.notify_all()
            yield message
