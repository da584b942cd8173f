"""The channel and the stream of poses under asyncio; `sync/transport.py` gives the same names to threads."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
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


def open_channel(address: str, tls: Tls | None) -> grpc.aio.Channel:
    """A channel of the running event loop; `tls` None: not encrypted."""
    if tls is None:
        return grpc.aio.insecure_channel(address, options=CHANNEL_OPTIONS)
    return grpc.aio.secure_channel(address, tls.credentials(), options=tls.options())


async def run_blocking(function: Callable[P, R], *arguments: P.args, **keywords: P.kwargs) -> R:
    """The result of a function that waits for the disk, called in a thread."""
    return await asyncio.to_thread(function, *arguments, **keywords)


class _CallThatKeepsItsStatus:
    """The inner call of a stream under grpc.aio, which gives up the answers and the status that the service sent when
    a write fails because the stream is over (https://github.com/grpc/grpc/issues/36066). This one keeps them.
    """

    def __init__(self, inner: Any) -> None:
        self._inner = inner

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    async def send_serialized_message(self, message: bytes) -> None:
        """Raises StreamEnded where the stream is over; reading says why."""
        try:
            await self._inner.send_serialized_message(message)
        except grpc.aio.InternalError:
            raise StreamEnded(TAKES_NO_MORE) from None


class PoseCall:
    """The calls of a stream, one after another: poses out, frames in. All raise ClientError where none can follow.

    A call that broke is followed by another when the caller asks for the next answer; meanwhile poses wait. Of a latest
    stream a task takes answers as they come; each is acknowledged when the caller takes it.
    """

    def __init__(self, start: Callable[[], Any], exchange: PoseExchange, retries: Retries, address: str) -> None:
        self.reconnections = 0
        self._start, self._exchange, self._retries, self._address = start, exchange, retries, address
        self._is_latest = exchange.mode is StreamMode.LATEST
        self._unanswered = Unanswered(newest_alone=self._is_latest, goes_on=retries.may_go_on)
        self._unsent: deque[Any] = deque()  # of the call that is open
        self._sending = asyncio.Lock()
        self._closed = False  # no more poses come
        self._failure: ClientError | None = None  # that ended the stream
        self._is_resumed = False  # the call that is open has brought nothing yet, and is not the first one
        self._waiting_to_go_on = 0  # poses since the call broke
        self._may_send = asyncio.Event()
        self._lost = 0
        self._answers = NewestAnswers()
        self._come = asyncio.Event()  # an answer, or the end of them
        self._taken = asyncio.Event()
        self._taken_sequence = 0
        self._tasks: tuple[asyncio.Task[None], ...] = ()  # of a latest stream, once it has begun
        self._resending: asyncio.Task[None] | None = None
        self._open()

    async def send(self, message: Any) -> None:
        """Raises StreamEnded where no more are taken."""
        if self._waiting_to_go_on >= MAX_WAITING and not self._is_latest:
            await self._may_send.wait()
        async with self._sending:
            if self._failure is not None:
                raise self._failure
            if self._closed:
                raise StreamEnded(TAKES_NO_MORE)
            self._begin()
            self._unanswered.sent(message)
            self._unsent.append(message)
            if await self._send_waiting():
                return
        if not self._retries.may_go_on:
            raise StreamEnded(TAKES_NO_MORE)
        self._waiting_to_go_on += 1

    async def done_sending(self) -> None:
        """Takes no more poses."""
        self._closed = True
        async with self._sending:
            await self._send_waiting()

    async def receive(self) -> Answer | None:
        """The next answer, of a latest stream the newest one; None after the last one."""
        if not self._is_latest:
            return await self._next()
        self._begin()
        await self._come.wait()
        if self._answers:
            answer = self._answers.take()
            if not self._answers and not self._tasks[0].done():
                self._come.clear()
            self._taken_sequence = answer.message.sequence
            self._taken.set()
            return answer
        if self._failure is not None:
            raise self._failure
        return None

    def take_replaced(self) -> int:
        """The number of poses since the last call that got no frame: lost with a connection, or replaced by newer
        ones.
        """
        lost, self._lost = self._lost, 0
        return lost + self._answers.take_skipped()

    async def close(self) -> None:
        self._closed = True
        self._call.cancel()
        tasks = [task for task in (*self._tasks, self._resending) if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _open(self) -> None:
        """Starts a call for the poses that have no answer."""
        self._unsent = deque([self._exchange.opening(), *self._unanswered.again()])
        self._lost += self._unanswered.take_lost()
        self._call = self._start()
        self._call._cython_call = _CallThatKeepsItsStatus(self._call._cython_call)

    async def _send_waiting(self) -> bool:
        """Sends what waits; False where the call is over: reading says why."""
        call = self._call
        try:
            while self._unsent:
                await self._call.write(self._unsent.popleft())
            if self._closed:
                await self._call.done_writing()
        except (asyncio.InvalidStateError, StreamEnded, grpc.RpcError):
            return call is not self._call  # else another call has begun meanwhile, with all that has no answer
        return True

    async def _resend(self) -> None:
        async with self._sending:
            await self._send_waiting()

    async def _next(self) -> Answer | None:
        while True:
            call = self._call
            try:
                message = await call.read()
            except grpc.RpcError as failure:
                if not await self._go_on(call, error_of_call(failure, self._address)):
                    return None
                continue
            if message is grpc.aio.EOF:
                return None
            if self._unanswered.answered(message):
                self._retries.progress()
                self.reconnections += self._is_resumed
                self._is_resumed = False
                return self._exchange.arrived(message)

    async def _go_on(self, broken: Any, error: ClientError) -> bool:
        """Starts another call after a pause; False where nothing is left to be asked. Raises what ends the stream."""
        try:
            pause_s = self._retries.pause_s(error)
            if self._closed and not self._unanswered:
                return False
            await asyncio.sleep(pause_s)
            if self._call is broken:
                self._open()
                self._is_resumed = True
                self._waiting_to_go_on = 0
                self._resending = asyncio.ensure_future(self._resend())
        except ClientError as final:
            self._failure = final
            raise
        finally:
            self._may_send.set()
            self._may_send.clear()
        return True

    def _begin(self) -> None:
        if self._is_latest and not self._tasks:
            self._tasks = tuple(map(asyncio.ensure_future, (self._take_answers(), self._acknowledge())))

    async def _take_answers(self) -> None:
        try:
            while (answer := await self._next()) is not None:
                self._answers.put(answer)
                self._come.set()
        except ClientError:
            pass  # the caller is told when there is no answer left
        finally:
            self._come.set()
            self._tasks[1].cancel()

    async def _acknowledge(self) -> None:
        while True:
            await self._taken.wait()
            self._taken.clear()
            async with self._sending:
                self._unsent.append(self._exchange.acknowledgement(self._taken_sequence))
                await self._send_waiting()
