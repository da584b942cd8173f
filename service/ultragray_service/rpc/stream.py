"""RenderStream: poses in, frames out."""

from __future__ import annotations

import grpc

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray.settings import Resolved
from ultragray_proto.v1 import rendering_pb2

from ..core.pose_stream import Answered, Asked, PoseStream, StreamMode
from ..core.state import Service
from .messages import error_message, frame_message, pose_from_message
from .planning import resolved_settings

_MODES = {
    rendering_pb2.STREAM_MODE_UNSPECIFIED: StreamMode.ORDERED,
    rendering_pb2.STREAM_MODE_ORDERED: StreamMode.ORDERED,
    rendering_pb2.STREAM_MODE_LATEST: StreamMode.LATEST,
}


MAX_TIMEOUT_MS = 3_600_000.0


class FrameStream:
    """One call of RenderStream."""

    def __init__(self, service: Service, context: grpc.aio.ServicerContext) -> None:
        self._service = service
        self._context = context
        self._settings: tuple[str, Resolved] | None = None  # with the scene

    async def run(self) -> None:
        """Until the client has sent its last message and got its last frame.

        Raises Draining when the service stops, InvalidArgument for a mode that does not exist.
        """
        stream = PoseStream(self._service)

        async def read() -> None:
            message = await self._context.read()
            if message is not grpc.aio.EOF:
                stream.mode = _mode(message)
            while message is not grpc.aio.EOF:
                await self._take(message, stream)
                message = await self._context.read()

        await stream.run(read, self._write)

    async def _take(self, message: rendering_pb2.RenderStreamRequest, stream: PoseStream) -> None:
        client_time = message.client_time_ns if message.HasField("client_time_ns") else None
        try:
            if message.HasField("settings"):
                self._settings = await resolved_settings(self._service, message)
                if not message.HasField("pose"):
                    return
            if self._settings is None:
                raise InvalidArgument("settings is required before the first pose", field="settings")
            if not message.HasField("pose"):
                raise InvalidArgument("pose or settings is required", field="pose")
            scene, settings = self._settings
            asked = Asked(
                sequence=message.sequence,
                client_time=client_time,
                scene=scene,
                settings=settings,
                pose=pose_from_message(message.pose, "pose"),
                deadline=self._service.planner.deadline(self._timeout_s(message)),
            )
        except UltragrayError as error:
            await stream.refuse(message.sequence, client_time, error)
        else:
            await stream.ask(asked)

    def _timeout_s(self, message: rendering_pb2.RenderStreamRequest) -> float | None:
        of_call_s: float | None = self._context.time_remaining()
        if not message.HasField("timeout_ms"):
            return of_call_s
        if not 0.0 < message.timeout_ms <= MAX_TIMEOUT_MS:
            raise InvalidArgument(
                f"timeout_ms must be above 0 and at most {MAX_TIMEOUT_MS:g}, got {message.timeout_ms:g}",
                field="timeout_ms",
            )
        timeout_s: float = message.timeout_ms / 1000.0
        return timeout_s if of_call_s is None else min(of_call_s, timeout_s)

    async def _write(self, answered: Answered) -> None:
        if isinstance(answered.outcome, UltragrayError):
            message = rendering_pb2.Frame(sequence=answered.sequence, error=error_message(answered.outcome))
        else:
            message = frame_message(answered.outcome, answered.sequence)
        message.dropped = answered.dropped
        if answered.client_time is not None:
            message.client_time_ns = int(answered.client_time)
        await self._context.write(message)


def _mode(message: rendering_pb2.RenderStreamRequest) -> StreamMode:
    if message.mode not in _MODES:
        raise InvalidArgument(f"mode must be one of the enum StreamMode, got {message.mode}", field="mode")
    return _MODES[message.mode]
