"""The channel and the stream of poses under threads; `aio/transport.py` gives the same names to asyncio."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, ParamSpec, TypeVar

import grpc

from ultragray_client.connection import CHANNEL_OPTIONS, Retries, Tls, error_of_call
from ultragray_client.exchange import (
    MAX_WAITING,
    TAKES_NO_MORE,
    Answer,
    NewestAnswers,
    PoseExchange,
    StreamMode,
    Unanswered,
)

from ..errors import ClientError, StreamEnded

P = ParamSpec("P")
R = TypeVar("R")


def open_channel(address: str, tls: Tls | None) -> grpc.Channel:
    """A channel that threads may share; `tls` None: not encrypted."""
    if tls is None:
        return grpc.insecure_channel(address, options=CHANNEL_OPTIONS)
    return grpc.secure_channel(address, tls.credentials(), options=tls.options())


def run_blocking(function: Callable[P, R], *arguments: P.args, **keywords: P.kwargs) -> R:
    """The result of a function that waits for the disk, called here: the caller's thread may wait."""
    return function(*arguments, **keywords)


class PoseCall:
    """The calls of a stream, one after another: poses out, frames in. All raise ClientError where none can follow.

    Poses wait in a bounded queue for the thread of the connection. In an ordered stream a full queue makes the sender
    wait; in a latest one the newest pose takes the place of one that waits, and a thread takes answers as they come;
    each is acknowledged when the caller takes it. A call that broke is followed by another when the next answer is
    asked for; meanwhile poses wait.
    """

    def __init__(self, start: Callable[..., Any], exchange: PoseExchange, retries: Retries, address: str) -> None:
        self.reconnections = 0
        self._start, self._exchange, self._retries, self._address = start, exchange, retries, address
        self._is_latest = exchange.mode is StreamMode.LATEST
        self._unanswered = Unanswered(newest_alone=self._is_latest, goes_on=retries.may_go_on)
        self._opening: Any = None
        self._unsent: deque[Any] = deque()  # of the call that is open
        self._changed = threading.Condition()
        self._closed = False  # no more poses come
        self._cancelled = False
        self._failure: ClientError | None = None  # that ended the stream
        self._is_resumed = False  # the call that is open has brought nothing yet, and is not the first one
        self._replaced = 0
        self._answers = NewestAnswers()
        self._acknowledgement: Any = None  # to be sent
        self._over = False  # no more answers come
        self._open()
        if self._is_latest:
            threading.Thread(target=self._take_answers, name="ultragray-stream", daemon=True).start()

    def send(self, message: Any) -> None:
        """Raises StreamEnded where no more are taken."""
        with self._changed:
            while not self._closed and not self._is_latest and len(self._unsent) >= MAX_WAITING:
                self._changed.wait()
            if self._failure is not None:
                raise self._failure
            if self._closed:
                raise StreamEnded(TAKES_NO_MORE)
            if self._is_latest and self._unsent and self._unsent[-1] is not self._opening:
                self._unsent.pop()
                self._unanswered.replaced()
                self._replaced += 1
            self._unanswered.sent(message)
            self._unsent.append(message)
            self._changed.notify_all()

    def done_sending(self) -> None:
        """Takes no more poses; those that wait still go out."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def receive(self) -> Answer | None:
        """The next answer, of a latest stream the newest one; None after the last one."""
        if not self._is_latest:
            return self._next()
        with self._changed:
            while not self._answers and not self._over:
                self._changed.wait()
            if self._answers:
                answer = self._answers.take()
                self._acknowledgement = self._exchange.acknowledgement(answer.message.sequence)
                self._changed.notify_all()
                return answer
            if self._failure is not None:
                raise self._failure
            return None

    def take_replaced(self) -> int:
        """The number of poses since the last call that got no frame: lost with a connection, or replaced by newer
        ones.
        """
        with self._changed:
            replaced, self._replaced = self._replaced, 0
            return replaced + self._answers.take_skipped()

    def close(self) -> None:
        with self._changed:
            self._closed = self._cancelled = True
            self._changed.notify_all()
            call = self._call
        call.cancel()

    def _open(self) -> None:
        """Starts a call for the poses that have no answer."""
        with self._changed:
            self._opening = self._exchange.opening()
            self._unsent = deque([self._opening, *self._unanswered.again()])
            self._replaced += self._unanswered.take_lost()
            self._acknowledgement = None
            self._call = call = self._start(self._messages(self._unsent))
            self._changed.notify_all()
        if not call.add_callback(partial(self._ended, call)):
            self._ended(call)

    def _messages(self, unsent: deque[Any]) -> Iterator[Any]:
        """What waits for a call, until another call takes its place, or no more poses come."""
        while True:
            with self._changed:
                while unsent is self._unsent and not (unsent or self._acknowledgement or self._closed):
                    self._changed.wait()
                if unsent is not self._unsent:
                    return
                if self._acknowledgement and not (unsent and unsent[0] is self._opening):
                    message, self._acknowledgement = self._acknowledgement, None
                elif unsent:
                    message = unsent.popleft()
                    self._changed.notify_all()
                else:
                    return
            yield message

    def _ended(self, call: Any) -> None:
        """Frees senders that wait for a call that is over, where none will follow; reading tells the reason, too."""
        failure = None
        if call.code() is not grpc.StatusCode.OK:
            failure = error_of_call(call, self._address)
            if self._retries.may_help(failure):
                return
        with self._changed:
            if call is self._call:
                self._closed, self._failure = True, failure
                self._changed.notify_all()

    def _next(self) -> Answer | None:
        while True:
            call = self._call
            try:
                message = next(call, None)
            except grpc.RpcError as failure:
                if not self._go_on(call, error_of_call(failure, self._address)):
                    return None
                continue
            if message is None:
                return None
            with self._changed:
                if self._unanswered.answered(message):
                    self._retries.progress()
                    self.reconnections += self._is_resumed
                    self._is_resumed = False
                    return self._exchange.arrived(message)

    def _go_on(self, broken: Any, error: ClientError) -> bool:
        """Starts another call after a pause; False where nothing is left to be asked. Raises what ends the stream."""
        try:
            pause_s = self._retries.pause_s(error)
            with self._changed:
                if self._closed and not self._unanswered:
                    return False
                self._changed.wait_for(lambda: self._cancelled, timeout=pause_s)
                if self._cancelled:
                    raise error
                if self._call is broken:
                    self._is_resumed = True
                    self._open()
        except ClientError as final:
            with self._changed:
                self._closed, self._failure = True, final
                self._changed.notify_all()
            raise
        return True

    def _take_answers(self) -> None:
        try:
            while (answer := self._next()) is not None:
                with self._changed:
                    self._answers.put(answer)
                    self._changed.notify_all()
        except ClientError:
            pass  # the caller is told when there is no answer left
        finally:
            with self._changed:
                self._over = True
                self._changed.notify_all()
