"""RenderStream: what a call of gRPC adds to a stream."""

from __future__ import annotations

from typing import Any

import grpc

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray.probe import FloatArray
from ultragray_proto.codec import to_message
from ultragray_proto.v1 import rendering_pb2, scenes_pb2
from ultragray_service.core.open_streams import Answered
from ultragray_service.core.streams import MAX_WINDOW, SceneSettings, StreamMode, checked_s
from ultragray_service.errors import Refusal
from ultragray_service.rpc.messages import frame_message, read_pose, read_settings, read_word
from ultragray_service.rpc.shared_memory import SharedMemory


class _Message:
    """A RenderStreamRequest."""

    def __init__(self, message: rendering_pb2.RenderStreamRequest, left_s: float | None) -> None:
        self.message = message
        self.sequence: int = message.sequence
        self.client_time: int | None = message.client_time_ns if message.HasField("client_time_ns") else None
        self.acknowledged: int | None = message.acknowledged if message.HasField("acknowledged") else None
        self._left_s = left_s  # until the deadline of the call

    @property
    def window(self) -> int | None:
        """Raises InvalidArgument for one beyond the limit."""
        if self.message.window > MAX_WINDOW:
            raise InvalidArgument(
                f"window must be at most {MAX_WINDOW}, 0 for none, got {self.message.window}", field="window"
            )
        return self.message.window or None

    def settings(self) -> SceneSettings | None:
        return read_settings(self.message) if self.message.HasField("settings") else None

    @property
    def asks(self) -> bool:
        return self.message.HasField("pose") or not (self.message.HasField("settings") or self.acknowledged is not None)

    def pose(self) -> FloatArray:  # [4, 4] mm
        if not self.message.HasField("pose"):
            raise InvalidArgument("pose or settings is required", field="pose")
        return read_pose(self.message.pose, "pose")

    def timeout_s(self) -> float | None:
        if not self.message.HasField("timeout_ms"):
            return self._left_s
        timeout_s = checked_s("timeout_ms", self.message.timeout_ms)
        return timeout_s if self._left_s is None else min(self._left_s, timeout_s)


class _Unreadable:
    """Bytes that are no RenderStreamRequest; they raise why where their contents are asked for."""

    sequence = 0
    client_time = window = acknowledged = None
    asks = True

    def __init__(self, error: InvalidArgument) -> None:
        self._error = error

    def settings(self) -> SceneSettings | None:
        return None

    def pose(self) -> FloatArray:
        raise self._error

    def timeout_s(self) -> float | None:
        return None


class CallTransport:
    """One call of RenderStream; a context manager. Its mode is read from the first message that can be read."""

    def __init__(self, context: grpc.aio.ServicerContext) -> None:
        self._context = context
        self.destination: SharedMemory | None = None

    def __enter__(self) -> CallTransport:
        return self

    def __exit__(self, *_: object) -> None:
        if self.destination is not None:
            self.destination.close()

    async def receive(self) -> _Message | _Unreadable | None:
        try:
            message = await self._context.read()
        except InvalidArgument as error:
            return _Unreadable(error)
        return None if message is grpc.aio.EOF else _Message(message, self._context.time_remaining())

    def mode(self, message: Any) -> StreamMode | None:
        """Opens the memory that the client shares, too.

        Raises InvalidArgument for a mode that does not exist, and for memory that is refused.
        """
        if isinstance(message, _Unreadable):
            return None
        mode = StreamMode(read_word(message.message, "mode") or StreamMode.ORDERED)
        if message.message.HasField("shared_memory"):
            self.destination = SharedMemory(message.message.shared_memory, self._context.peer())
        return mode

    async def send(self, answered: Answered) -> None:
        about: dict[str, Any] = {"dropped": answered.dropped}
        if answered.client_time is not None:
            about["client_time_ns"] = int(answered.client_time)
        if isinstance(answered.outcome, UltragrayError):
            error = to_message(Refusal.of(answered.outcome), scenes_pb2.Error)
            await self._context.write(rendering_pb2.Frame(sequence=answered.sequence, error=error, **about))
        else:
            await self._context.write(frame_message(answered.outcome, answered.sequence, **about))

    hand_over = send  # flow control tells the client's library what was taken, not the service
