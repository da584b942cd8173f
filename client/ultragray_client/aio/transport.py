"""The channel and the stream of poses under asyncio; `sync/transport.py` gives the same names to threads."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import grpc

from ..calls.connection import CHANNEL_OPTIONS
from ..calls.pose_exchange import TAKES_NO_MORE, PoseExchange
from ..errors import StreamEnded

P = ParamSpec("P")
R = TypeVar("R")


def open_channel(address: str) -> grpc.aio.Channel:
    """A channel of the running event loop."""
    return grpc.aio.insecure_channel(address, options=CHANNEL_OPTIONS)


async def run_blocking(function: Callable[P, R], *arguments: P.args, **keywords: P.kwargs) -> R:
    """The result of a function that waits for the disk, called in a thread."""
    return await asyncio.to_thread(function, *arguments, **keywords)


class PoseCall:
    """The call of a stream: poses out, frames in. All raise grpc.RpcError where the call failed."""

    def __init__(self, start: Callable[..., Any], exchange: PoseExchange) -> None:
        self._call = start()
        self._opening: Any = exchange.opening()
        self._sending = asyncio.Lock()

    async def send(self, message: Any) -> None:
        """Raises StreamEnded where no more are taken."""
        async with self._sending:
            try:
                if self._opening is not None:
                    opening, self._opening = self._opening, None
                    await self._call.write(opening)
                await self._call.write(message)
            except asyncio.InvalidStateError:
                raise StreamEnded(TAKES_NO_MORE) from None

    async def done_sending(self) -> None:
        """Takes no more poses."""
        async with self._sending:
            await self._call.done_writing()

    async def receive(self) -> Any:
        """The next answer; None after the last one."""
        answer = await self._call.read()
        return None if answer is grpc.aio.EOF else answer

    def take_replaced(self) -> int:
        """The number of poses replaced here since the last call: none, each is sent at once."""
        return 0

    async def close(self) -> None:
        self._call.cancel()
