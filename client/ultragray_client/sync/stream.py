# Generated from aio/stream.py by client/generate.py; change that file.
"""A stream of poses and frames."""

from __future__ import annotations

from collections.abc import Iterator

from ultragray_client.exchange import PoseExchange

from ..errors import StreamEnded
from ..frames import Frame
from ..geometry import PoseLike
from .transport import PoseCall


class FrameStream:
    """Poses in, frames out; sending and receiving may go on side by side. Leaving it as a context ends it."""

    def __init__(self, exchange: PoseExchange, call: PoseCall) -> None:
        self._exchange, self._call = exchange, call

    @property
    def reconnections(self) -> int:
        """How often frames went on over another connection."""
        return self._call.reconnections

    def send(self, pose: PoseLike, *, timeout_s: float | None = None, measured_ns: int | None = None) -> int:
        """Sends a pose ([4, 4] mm, or a Placement) and returns the sequence that its frame will carry, from 1.

        `timeout_s`: later than that the pose is not rendered, and `receive` raises DeadlineExceeded in place of its
        frame. `measured_ns`: when the pose was measured, of `time.monotonic_ns()` (default: now); the frame's
        `latency_ms` counts from it. Raises InvalidPose, StreamEnded, and what ended the stream.
        """
        message = self._exchange.pose(pose, timeout_s, measured_ns)
        self._call.send(message)
        return int(message.sequence)

    def done_sending(self) -> None:
        """No more poses come; the frames of those that were sent still do, then the iteration ends."""
        self._call.done_sending()

    def receive(self) -> Frame:
        """Waits for the next frame; of a latest stream the newest: those it takes the place of are dropped.

        Raises the ClientError that is told in its place, with the `sequence` of its pose: the stream goes on. Raises
        StreamEnded after the last frame, and what ended the stream, such as Unreachable where it could not go on.
        """
        answer = self._call.receive()
        if answer is None:
            raise StreamEnded("the stream is over")
        return self._exchange.frame(answer, self._call.take_replaced())

    def __iter__(self) -> Iterator[Frame]:
        return self

    def __next__(self) -> Frame:
        try:
            return self.receive()
        except StreamEnded:
            raise StopIteration from None

    def __enter__(self) -> FrameStream:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._call.close()
        finally:
            self._exchange.close()
