"""A stream of poses and frames."""

from __future__ import annotations

from collections.abc import Iterator
from types import TracebackType

import grpc

from ..errors import ClientError, StreamEnded
from ..frames import Frame
from ..geometry import PoseLike
from ..pose_exchange import PoseExchange, StreamMode
from ..statuses import error_of_call
from .connection import Connection
from .outbox import Outbox


class FrameStream:
    """Poses in, frames out; sending and receiving may be in threads of their own. Leaving it as a context ends it."""

    def __init__(self, connection: Connection, exchange: PoseExchange, timeout_s: float | None) -> None:
        self._address = connection.address
        self._exchange = exchange
        self._outbox = Outbox(exchange.opening(), replaces=exchange.mode is StreamMode.LATEST)
        self._call = connection.stubs.rendering.RenderStream(
            iter(self._outbox), timeout=timeout_s, metadata=connection.metadata
        )
        if not self._call.add_callback(self._outbox.close):
            self._outbox.close()

    def send(self, pose: PoseLike, *, timeout_s: float | None = None, measured_ns: int | None = None) -> int:
        """Sends a pose ([4, 4] mm, or a Placement) and returns the sequence that its frame will carry, from 1.

        `timeout_s`: later than that the pose is not rendered, and `receive` raises DeadlineExceeded in place of its
        frame. `measured_ns`: when the pose was measured, of `time.monotonic_ns()` (default: now); the frame's
        `latency_ms` counts from it. Raises InvalidPose, StreamEnded, and what ended the stream.
        """
        message = self._exchange.pose(pose, timeout_s, measured_ns)
        if not self._outbox.put(message):
            raise self._ending()
        return int(message.sequence)

    def done_sending(self) -> None:
        """No more poses come; the frames of those that were sent still do, then the iteration ends."""
        self._outbox.close()

    def receive(self) -> Frame:
        """Waits for the next frame.

        Raises the ClientError that is told in its place, with the `sequence` of its pose: the stream goes on. Raises
        StreamEnded after the last frame, and what ended the stream, such as Draining: open another one.
        """
        frame = next(self, None)
        if frame is None:
            raise StreamEnded("the stream is over")
        return frame

    def __iter__(self) -> Iterator[Frame]:
        return self

    def __next__(self) -> Frame:
        try:
            message = next(self._call)
        except grpc.RpcError as failure:
            raise error_of_call(failure, self._address) from None
        return self._exchange.frame(message, self._outbox.take_replaced())

    def _ending(self) -> ClientError:
        if self._call.is_active() or self._call.code() is grpc.StatusCode.OK:
            return StreamEnded("the stream takes no more poses: done_sending was called, or it is over")
        return error_of_call(self._call, self._address)

    def __enter__(self) -> FrameStream:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._outbox.close()
        self._call.cancel()
