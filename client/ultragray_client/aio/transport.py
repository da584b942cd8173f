"""The channel and the stream of poses under asyncio; `sync/transport.py` gives the same names to threads."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import grpc

from ..calls.connection import CHANNEL_OPTIONS
from ..calls.newest_answers import NewestAnswers
from ..calls.pose_exchange import TAKES_NO_MORE, PoseExchange, StreamMode
from ..calls.tls import Tls
from ..errors import StreamEnded

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
    """The call of a stream: poses out, frames in. All raise grpc.RpcError where the call failed.

    Of a latest stream a task takes answers as they come; each is acknowledged when the caller takes it.
    """

    def __init__(self, start: Callable[..., Any], exchange: PoseExchange) -> None:
        self._call = start()
        self._call._cython_call = _CallThatKeepsItsStatus(self._call._cython_call)
        self._exchange = exchange
        self._opening: Any = exchange.opening()
        self._sending = asyncio.Lock()
        self._answers = NewestAnswers(exchange.skip)
        self._come = asyncio.Event()  # an answer, or the end of them
        self._taken = asyncio.Event()
        self._taken_sequence = 0
        self._tasks: tuple[asyncio.Task[None], ...] = ()  # of a latest stream, once it has begun

    async def send(self, message: Any) -> None:
        """Raises StreamEnded where no more are taken."""
        async with self._sending:
            try:
                if self._opening is not None:
                    opening, self._opening = self._opening, None
                    self._begin()
                    await self._call.write(opening)
                await self._call.write(message)
            except asyncio.InvalidStateError:
                raise StreamEnded(TAKES_NO_MORE) from None

    async def done_sending(self) -> None:
        """Takes no more poses."""
        async with self._sending:
            await self._call.done_writing()

    async def receive(self) -> Any:
        """The next answer, of a latest stream the newest one; None after the last one."""
        self._begin()
        if self._tasks:
            await self._come.wait()
            if self._answers:
                answer = self._answers.take()
                if not self._answers and not self._tasks[0].done():
                    self._come.clear()
                self._taken_sequence = answer.sequence
                self._taken.set()
                return answer
        answer = await self._call.read()
        return None if answer is grpc.aio.EOF else answer

    def take_replaced(self) -> int:
        """The number of poses replaced here since the last call, and of frames that newer ones took the place of."""
        return self._answers.take_skipped()

    async def close(self) -> None:
        self._call.cancel()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _begin(self) -> None:
        if self._exchange.mode is StreamMode.LATEST and not self._tasks:
            self._tasks = tuple(map(asyncio.ensure_future, (self._take_answers(), self._acknowledge())))

    async def _take_answers(self) -> None:
        try:
            while (answer := await self._call.read()) is not grpc.aio.EOF:
                self._answers.put(answer)
                self._come.set()
        except grpc.RpcError:
            pass  # reading once more raises it again, for the caller
        finally:
            self._come.set()
            self._tasks[1].cancel()

    async def _acknowledge(self) -> None:
        while True:
            await self._taken.wait()
            self._taken.clear()
            async with self._sending:
                try:
                    await self._call.write(self._exchange.acknowledgement(self._taken_sequence))
                except (asyncio.InvalidStateError, StreamEnded, grpc.RpcError):
                    return  # nothing is sent any more
