"""The messages of a stream, there and back."""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import Enum

from ultragray_proto.v1 import rendering_pb2

from ..errors import InvalidArgument
from ..frames import Frame, frame_from_message
from ..geometry import PoseLike, pose_message
from .shared_memory import SharedMemory
from .statuses import error_of_frame

MAX_WAITING = 64  # poses of an ordered stream; then its sender waits
WINDOW = 2  # answers of a latest stream that may wait for the caller: one comes while the other is looked at
TAKES_NO_MORE = "the stream takes no more poses: done_sending was called, or it is over"


class StreamMode(str, Enum):
    """The fate of a pose that still waits when the next one comes."""

    ORDERED = "ordered"  # every pose gets its frame, in order
    LATEST = "latest"  # for control loops: the newer pose takes its place; it gets no frame and is counted


@dataclass(frozen=True, eq=False)
class Answer:
    """A message of the service, and the memory that its pixels may lie in: each connection has its own."""

    message: rendering_pb2.Frame
    memory: SharedMemory | None

    def skip(self) -> None:
        """Nobody wants the frame."""
        if self.memory is not None:
            self.memory.skip(self.message)


class PoseExchange:
    """The messages of a stream: poses numbered from 1 (0 are its settings), and their frames."""

    def __init__(
        self, settings: rendering_pb2.RenderSettings, mode: StreamMode | str, *, shared_memory: bool = False
    ) -> None:
        """Raises InvalidArgument for a mode that does not exist, and where this system cannot share memory."""
        try:
            self.mode = StreamMode(mode)
        except ValueError:
            names = ", ".join(known.value for known in StreamMode)
            raise InvalidArgument(f"mode must be one of {names}, got {mode!r}", field="mode") from None
        self._settings = settings
        self._sequence = 0
        self._dropped = 0
        self._memory = SharedMemory() if shared_memory else None
        self._is_open = False

    @property
    def scene(self) -> str:
        """The scene whose frames are asked for."""
        return str(self._settings.scene)

    def opening(self) -> rendering_pb2.RenderStreamRequest:
        """The first message of a connection: settings and mode, no pose. If they are refused, the first answer says so.

        Raises InvalidArgument where there is no memory to share any more: each connection has its own.
        """
        if self._memory is not None and self._is_open:
            self._memory.close()
            self._memory = SharedMemory()
        self._is_open = True
        mode = f"STREAM_MODE_{self.mode.name}"
        window = WINDOW if self.mode is StreamMode.LATEST else None
        memory = None if self._memory is None else self._memory.message()
        return rendering_pb2.RenderStreamRequest(
            settings=self._settings, mode=mode, window=window, shared_memory=memory
        )

    def acknowledgement(self, sequence: int) -> rendering_pb2.RenderStreamRequest:
        """The message that the answer of that sequence was taken: a newer one may come."""
        return rendering_pb2.RenderStreamRequest(acknowledged=sequence)

    def pose(
        self, pose: PoseLike, timeout_s: float | None, measured_ns: int | None
    ) -> rendering_pb2.RenderStreamRequest:
        """The message of the next pose. Raises InvalidPose."""
        message = rendering_pb2.RenderStreamRequest(
            sequence=self._sequence + 1,
            pose=pose_message(pose),
            timeout_ms=None if timeout_s is None else 1000.0 * timeout_s,
            client_time_ns=time.monotonic_ns() if measured_ns is None else measured_ns,
        )
        self._sequence += 1
        return message

    def arrived(self, message: rendering_pb2.Frame) -> Answer:
        """A message that came over the connection that was opened last."""
        return Answer(message, self._memory)

    def frame(self, answer: Answer, dropped_here: int = 0) -> Frame:
        """The frame of an answer, with what was dropped since the one before.

        Raises ClientError, with the sequence of the pose, where the service told an error in its place.
        """
        message = answer.message
        self._dropped += message.dropped + dropped_here
        if message.HasField("error"):
            raise error_of_frame(message.error, message.sequence)
        dropped, self._dropped = self._dropped, 0
        data = None if answer.memory is None else answer.memory.taken(message)
        return frame_from_message(message, sequence=message.sequence, dropped=dropped, data=data)

    def close(self) -> None:
        """No frames are asked for any more; those that came stay."""
        if self._memory is not None:
            self._memory.close()
