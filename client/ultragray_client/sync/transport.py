"""The channel and the stream of poses under threads; `aio/transport.py` gives the same names to asyncio."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import grpc

from ..calls.connection import CHANNEL_OPTIONS
from ..calls.newest_answers import NewestAnswers
from ..calls.pose_exchange import TAKES_NO_MORE, PoseExchange, StreamMode
from ..calls.tls import Tls
from ..errors import StreamEnded

P = ParamSpec("P")
R = TypeVar("R")

_MAX_WAITING = 64


def open_channel(address: str, tls: Tls | None) -> grpc.Channel:
    """A channel that threads may share; `tls` None: not encrypted."""
    if tls is None:
        return grpc.insecure_channel(address, options=CHANNEL_OPTIONS)
    return grpc.secure_channel(address, tls.credentials(), options=tls.options())


def run_blocking(function: Callable[P, R], *arguments: P.args, **keywords: P.kwargs) -> R:
    """The result of a function that waits for the disk, called here: the caller's thread may wait."""
    return function(*arguments, **keywords)


class PoseCall:
    """The call of a stream: poses out, frames in. All raise grpc.RpcError where the call failed.

    Poses wait in a bounded queue for the thread of the connection. In an ordered stream a full queue makes the sender
    wait; in a latest one the newest pose takes the place of one that waits, and a thread takes answers as they come;
    each is acknowledged when the caller takes it.
    """

    def __init__(self, start: Callable[..., Any], exchange: PoseExchange) -> None:
        self._exchange = exchange
        self._opening = exchange.opening()
        self._replaces = exchange.mode is StreamMode.LATEST
        self._waiting: deque[Any] = deque([self._opening])
        self._changed = threading.Condition()
        self._closed = False
        self._replaced = 0
        self._answers = NewestAnswers(exchange.skip)
        self._acknowledgement: Any = None  # to be sent
        self._over = False  # no more answers come
        self._call = start(self._messages())
        if not self._call.add_callback(self.done_sending):
            self.done_sending()
        if self._replaces:
            threading.Thread(target=self._take_answers, name="ultragray-stream", daemon=True).start()

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
        """The next answer, of a latest stream the newest one; None after the last one."""
        if self._replaces:
            with self._changed:
                while not self._answers and not self._over:
                    self._changed.wait()
                if self._answers:
                    answer = self._answers.take()
                    self._acknowledgement = self._exchange.acknowledgement(answer.sequence)
                    self._changed.notify_all()
                    return answer
        return next(self._call, None)

    def take_replaced(self) -> int:
        """The number of poses replaced here since the last call, and of frames that newer ones took the place of."""
        with self._changed:
            replaced, self._replaced = self._replaced, 0
            return replaced + self._answers.take_skipped()

    def close(self) -> None:
        self.done_sending()
        self._call.cancel()

    def _messages(self) -> Iterator[Any]:
        while True:
            with self._changed:
                while not self._waiting and not self._acknowledgement and not self._closed:
                    self._changed.wait()
                if self._acknowledgement:
                    message, self._acknowledgement = self._acknowledgement, None
                elif self._waiting:
                    message = self._waiting.popleft()
                    self._changed.notify_all()
                else:
                    return
            yield message

    def _take_answers(self) -> None:
        try:
            for answer in self._call:
                with self._changed:
                    self._answers.put(answer)
                    self._changed.notify_all()
        except grpc.RpcError:
            pass  # reading once more raises it again, for the caller
        finally:
            with self._changed:
                self._over = True
                self._changed.notify_all()
