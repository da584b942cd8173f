"""A stream of poses and frames."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from types import TracebackType

import grpc

from ..errors import StreamEnded
from ..frames import Frame
from ..geometry import PoseLike
from ..pose_exchange import PoseExchange
from ..statuses import error_of_call
from .connection import AsyncConnection


class AsyncFrameStream:
    """Poses in, frames out; sending and receiving may be in tasks of their own. Leaving it as a context ends it."""

    def __init__(self, connection: AsyncConnection, exchange: PoseExchange, timeout_s: float | None) -> None:
        self._address = connection.address
        self._exchange = exchange
        self._call = connection.stubs.rendering.RenderStream(timeout=timeout_s, metadata=connection.metadata)
        self._opened = False
        self._sending = asyncio.Lock()

    async def send(self, pose: PoseLike, *, timeout_s: float | None = None, measured_ns: int | None = None) -> int:
        """Sends a pose ([4, 4] mm, or a Placement) and returns the sequence that its frame will carry, from 1.

        `timeout_s`: later than that the pose is not rendered, and `receive` raises DeadlineExceeded in place of its
        frame. `measured_ns`: when the pose was measured, of `time.monotonic_ns()` (default: now); the frame's
        `latency_ms` counts from it. Raises InvalidPose, StreamEnded, and what ended the stream.
        """
        async with self._sending:
            message = self._exchange.pose(pose, timeout_s, measured_ns)
            try:
                if not self._opened:
                    self._opened = True
                    await self._call.write(self._exchange.opening())
                await self._call.write(message)
            except grpc.RpcError as failure:
                raise error_of_call(failure, self._address) from None
            except asyncio.InvalidStateError:
                raise StreamEnded("the stream takes no more poses: done_sending was called, or it is over") from None
        return int(message.sequence)

    async def done_sending(self) -> None:
        """No more poses come; the frames of those that were sent still do, then the iteration ends."""
        async with self._sending:
            await self._call.done_writing()

    async def receive(self) -> Frame:
        """Waits for the next frame.

        Raises the ClientError that is told in its place, with the `sequence` of its pose: the stream goes on. Raises
        StreamEnded after the last frame, and what ended the stream, such as Draining: open another one.
        """
        try:
            message = await self._call.read()
        except grpc.RpcError as failure:
            raise error_of_call(failure, self._address) from None
        if message is grpc.aio.EOF:
            raise StreamEnded("the stream is over")
        return self._exchange.frame(message)

    def __aiter__(self) -> AsyncIterator[Frame]:
        return self

    async def __anext__(self) -> Frame:
        try:
            return await self.receive()
        except StreamEnded:
            raise StopAsyncIteration from None

    async def __aenter__(self) -> AsyncFrameStream:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._call.cancel()
