"""The messages of a stream of poses, whatever carries them.

Poses wait for their answers, answers wait for the caller, and pixels may come through shared memory.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import secrets
import socket
import time
import weakref
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from statistics import median
from typing import Any

import numpy.typing as npt

from ultragray_client.connection import error_of_frame
from ultragray_client.contract import MAX_AHEAD_MS
from ultragray_client.errors import ClientError, Draining, InvalidArgument
from ultragray_client.frames import Frame, frame_from_message, image_fields
from ultragray_client.geometry import PoseLike, pose_message
from ultragray_client.messages import ReceivedFrame
from ultragray_proto.v1 import rendering_pb2

SLOTS = 16
SLOT_BYTES = 16 * 2**20  # whose pages take memory only once a frame was written there

_FOLDER = Path("/dev/shm")
_HEADER_BYTES = 4096
_TOKEN_BYTES = 32
_FREE = 1
_SOCKET = ".socket"  # behind the name of the file


class SharedMemory:
    """A file that the service writes frames into, and a socket beside it, which it connects to.

    A slot is free again when no array refers to it any more. The service removes the name of the file when it has
    opened it; `close`, or the end of this object, removes that of a file that it did not open, and the socket's.
    """

    def __init__(self) -> None:
        """Raises InvalidArgument where this system has no such memory."""
        self._token = secrets.token_bytes(_TOKEN_BYTES)
        path = _FOLDER / f"ultragray-{secrets.token_hex(16)}"
        size = _HEADER_BYTES + SLOTS * SLOT_BYTES
        try:
            self.listener = socket.socket(socket.AF_UNIX)
            self._remove = weakref.finalize(self, _remove, path, self.listener)
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
            try:
                os.ftruncate(descriptor, size)
                os.pwrite(descriptor, self._token + bytes([_FREE]) * SLOTS, 0)
                self._map = mmap.mmap(descriptor, size)
            finally:
                os.close(descriptor)
            self.listener.bind(f"{path}{_SOCKET}")
            os.chmod(f"{path}{_SOCKET}", 0o600)
            self.listener.listen(1)
        except (OSError, AttributeError) as error:  # the latter where Python knows no such sockets
            raise InvalidArgument(
                f"shared_memory cannot be had on this system: {error}", field="shared_memory"
            ) from None
        self._name = path.name
        self._process = os.getpid()
        self._lent: dict[int, weakref.ref[Any]] = {}

    def message(self) -> rendering_pb2.SharedMemory:
        """The file, as the service is told of it."""
        return rendering_pb2.SharedMemory(
            name=self._name, token=self._token, slots=SLOTS, slot_bytes=SLOT_BYTES, has_socket=True
        )

    def taken(self, message: rendering_pb2.Frame) -> Any:
        """The pixels of a frame, a buffer whose slot is not free while anything refers to it; None: the message has
        them.
        """
        if not message.HasField("shared_data"):
            return None
        slot, size = message.shared_data.slot, message.shared_data.bytes
        pixels = (ctypes.c_ubyte * size).from_buffer(self._map, _HEADER_BYTES + slot * SLOT_BYTES)
        self._lent[slot] = weakref.ref(pixels, lambda _: self._free(slot))
        return pixels

    def skip(self, message: rendering_pb2.Frame) -> None:
        """Frees the slot of a frame that nobody will look at."""
        if message.HasField("shared_data"):
            self._free(message.shared_data.slot)

    def close(self) -> None:
        """Removes the names that are still there; frames stay as they are."""
        self._remove()

    def _free(self, slot: int) -> None:
        if os.getpid() == self._process:  # a child by fork has its own references to what its parent still looks at
            self._map[_TOKEN_BYTES + slot] = _FREE


def _remove(path: Path, listener: socket.socket) -> None:
    listener.close()
    for name in (path, f"{path}{_SOCKET}"):
        with suppress(OSError):
            os.unlink(name)


# The messages of a stream, there and back.


MAX_WAITING = 64  # poses of an ordered stream; then its sender waits
_LATENCIES = 32  # of the newest frames, whose median is expected of the next
MAX_AGE_S = 60.0  # of a pose that is foretold: of another clock otherwise
WINDOW = 2  # answers of a latest stream that may wait for the caller: one comes while the other is looked at
TAKES_NO_MORE = "the stream takes no more poses: done_sending was called, or it is over"


class StreamMode(str, Enum):
    """The fate of a pose that still waits when the next one comes."""

    ORDERED = "ordered"  # every pose gets its frame, in order
    LATEST = "latest"  # for control loops: the newer pose takes its place; it gets no frame and is counted


@dataclass(frozen=True, eq=False)
class Answer:
    """A message of the service, and the memory that its pixels may lie in: each connection has its own."""

    received: ReceivedFrame
    memory: SharedMemory | None

    @property
    def message(self) -> rendering_pb2.Frame:
        """Without what it begins with."""
        return self.received.message

    def skip(self) -> None:
        """Nobody wants the frame."""
        if self.memory is not None:
            self.memory.skip(self.message)


class PoseExchange:
    """The messages of a stream: poses numbered from 1 (0 are its settings), and their frames."""

    def __init__(
        self,
        settings: rendering_pb2.RenderSettings,
        mode: StreamMode | str,
        *,
        shared_memory: bool | None = False,
        seen_after_ms: float | None = None,
    ) -> None:
        """`shared_memory` None: where this system and the service can share it.

        Raises InvalidArgument for a mode that does not exist, a `seen_after_ms` out of range, and where this system
        cannot share memory that is asked for.
        """
        if seen_after_ms is not None and not 0.0 <= seen_after_ms <= MAX_AHEAD_MS:
            raise InvalidArgument(
                f"seen_after_ms must be from 0 to {MAX_AHEAD_MS:g}, got {seen_after_ms:g}", field="seen_after_ms"
            )
        try:
            self.mode = StreamMode(mode)
        except ValueError:
            names = ", ".join(known.value for known in StreamMode)
            raise InvalidArgument(f"mode must be one of {names}, got {mode!r}", field="mode") from None
        self._settings = settings
        self._seen_after_ms = seen_after_ms
        self._latencies_ms: deque[float] = deque(maxlen=_LATENCIES)
        self._sequence = 0
        self._dropped = 0
        self._needs_memory = shared_memory is True
        self._memory = None if shared_memory is False else self._new_memory()
        self._is_open = False
        self._newest_ns: tuple[int, int] | None = None  # answer of this connection: when it was sent, and came

    @property
    def scene(self) -> str:
        """The scene whose frames are asked for."""
        return str(self._settings.scene)

    def opening(self) -> rendering_pb2.RenderStreamRequest:
        """The first message of a connection: settings and mode, no pose. If they are refused, the first answer says so.

        Raises InvalidArgument where there is no memory to share any more: each connection has its own.
        """
        if self._memory is not None and self._is_open:
            self.close()
            self._memory = self._new_memory()
        self._is_open, self._newest_ns = True, None
        mode = f"STREAM_MODE_{self.mode.name}"
        window = WINDOW if self.mode is StreamMode.LATEST else None
        memory = None if self._memory is None else self._memory.message()
        return rendering_pb2.RenderStreamRequest(
            settings=self._settings, mode=mode, window=window, shared_memory=memory
        )

    def goes_without_memory(self, refusal: ClientError) -> bool:
        """Whether a call ended only because the service cannot share memory, which nobody insists on."""
        field = refusal.field or ""
        return self._memory is not None and not self._needs_memory and field.startswith("shared_memory")

    def give_up_memory(self) -> None:
        """Frames come in messages from the next call on."""
        self.close()
        self._memory = None

    @property
    def may_give_up_memory(self) -> bool:
        """Whether the service has not said yet that it shares memory, which nobody insists on."""
        return self._memory is not None and not self._needs_memory and self._newest_ns is None

    @property
    def listener(self) -> socket.socket | None:
        """Where the service connects to for the messages of a connection that was opened; None: they go through it."""
        return None if self._memory is None else self._memory.listener

    def pose(
        self, pose: PoseLike, timeout_s: float | None, measured_ns: int | None
    ) -> rendering_pb2.RenderStreamRequest:
        """The message of the next pose. Raises InvalidPose, and InvalidArgument for a time of another clock."""
        if measured_ns is not None and self._seen_after_ms is not None:
            require_own_clock(measured_ns)
        message = rendering_pb2.RenderStreamRequest(
            sequence=self._sequence + 1,
            pose=pose_message(pose),
            timeout_ms=None if timeout_s is None else 1000.0 * timeout_s,
            client_time_ns=time.monotonic_ns() if measured_ns is None else measured_ns,
            predict_ms=self._predict_ms(),
        )
        self._sequence += 1
        return message

    def real(self, image: npt.ArrayLike | bytes, measured_ns: int) -> rendering_pb2.RenderStreamRequest:
        """The message of a real frame. Raises InvalidArgument."""
        real = rendering_pb2.RealFrame(client_time_ns=measured_ns, **image_fields(image))
        return rendering_pb2.RenderStreamRequest(real=real)

    def departing(
        self, message: rendering_pb2.RenderStreamRequest | None, taken: int | None
    ) -> rendering_pb2.RenderStreamRequest:
        """A message as it goes: with what aligns the clocks of client and service, and with the sequence of the answer
        that was `taken` since the one before, which makes room for a newer one. None: it tells nothing else.
        """
        message = message or rendering_pb2.RenderStreamRequest()
        for name in ("clock", "acknowledged"):
            message.ClearField(name)  # of one that goes again
        if taken is not None:
            message.acknowledged = taken
        if self._newest_ns is not None:
            sent_ns, arrived_ns = self._newest_ns
            stamps = {"answer_sent_ns": sent_ns, "answer_arrived_ns": arrived_ns, "sent_ns": time.monotonic_ns()}
            message.clock.CopyFrom(rendering_pb2.ClockStamps(**stamps))
        return message

    def arrived(self, received: ReceivedFrame) -> Answer:
        """A message that came over the connection that was opened last."""
        self._newest_ns = received.message.sent_ns, time.monotonic_ns()
        return Answer(received, self._memory)

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
        frame = frame_from_message(answer.received, sequence=message.sequence, dropped=dropped, data=data)
        if frame.latency_ms is not None:
            self._latencies_ms.append(frame.latency_ms)
        return frame

    def _new_memory(self) -> SharedMemory | None:
        """Raises InvalidArgument where there is none that is insisted on."""
        try:
            return SharedMemory()
        except InvalidArgument:
            if self._needs_memory:
                raise
            return None

    def _predict_ms(self) -> float | None:
        """From the measurement of the next pose to when its frame will be seen; None: no pose is to be foretold."""
        if self._seen_after_ms is None:
            return None
        return min(self._seen_after_ms + median(self._latencies_ms or [0.0]), MAX_AHEAD_MS)

    def close(self) -> None:
        """No frames are asked for any more; those that came stay."""
        if self._memory is not None:
            self._memory.close()


def require_own_clock(measured_ns: int) -> None:
    """Raises InvalidArgument for a time that is not of the last MAX_AGE_S of `time.monotonic_ns()`."""
    age_s = (time.monotonic_ns() - measured_ns) / 1e9
    if not -1.0 <= age_s <= MAX_AGE_S:
        raise InvalidArgument(
            f"measured_ns must be of time.monotonic_ns(), since seen_after_ms counts from then to now: got a time "
            f"{abs(age_s):,.0f} s {'ago' if age_s > 0.0 else 'ahead'}",
            field="measured_ns",
        )


# The answers of a latest stream that have come and wait for the caller.


class NewestAnswers:
    """Answers in their order; of frames that nobody came for, only the newest one is kept."""

    def __init__(self) -> None:
        self._waiting: deque[Answer] = deque()
        self._skipped = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, answer: Answer) -> None:
        """An answer has come. It takes the place of a frame; a refusal that waits is kept, and told before it."""
        if self._waiting and not any(one.message.HasField("error") for one in (self._waiting[-1], answer)):
            skipped = self._waiting.pop()
            self._skipped += 1 + skipped.message.dropped
            skipped.skip()
        self._waiting.append(answer)

    def take(self) -> Answer:
        """The oldest of those that are kept."""
        return self._waiting.popleft()

    def take_skipped(self) -> int:
        """The number of poses without a frame for the caller since the last call: skipped here, and dropped before."""
        skipped, self._skipped = self._skipped, 0
        return skipped


# The poses of a stream that have no answer yet, for when its connection is lost.


_LEAST_TIMEOUT_MS = 1e-3  # of a pose whose time has passed: the service tells that it came too late


class Unanswered:
    """The poses that another connection is asked for: all without an answer, of a latest stream the newest alone."""

    def __init__(self, *, newest_alone: bool, goes_on: bool = True) -> None:
        """`goes_on`: whether the stream may go on over another connection."""
        self._newest_alone, self._goes_on = newest_alone, goes_on
        self._waiting: dict[int, tuple[rendering_pb2.RenderStreamRequest, float]] = {}  # by sequence, with send times
        self._open = 0  # poses of which nothing was told: no answer, and not that a newer one took their place
        self._replaced_at_last = 0  # poses that newer ones replaced, told with answers that the caller does not get

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def add(self, message: rendering_pb2.RenderStreamRequest) -> None:
        """A pose goes out."""
        if self._newest_alone:
            self._waiting.clear()
        self._waiting[message.sequence] = message, time.monotonic()
        self._open += 1

    def replaced(self) -> None:
        """A newer pose took the place of one before that went out."""
        self._open -= 1

    def answered(self, message: rendering_pb2.Frame) -> bool:
        """A frame came, or why there is none; with the number of poses that newer ones replaced in the service.

        False where the service stops and refused the pose: another one will be asked for it.
        """
        self._open -= message.dropped
        if self._goes_on and message.error.reason == Draining.reason:
            self._replaced_at_last += message.dropped
            return False
        self._open -= 1 if message.sequence else 0  # 0: of the settings
        self._waiting.pop(message.sequence, None)
        return True

    def again(self) -> list[rendering_pb2.RenderStreamRequest]:
        """The poses to send over another connection, in their order, each with what is left of its time."""
        return [_with_time_left(message, sent_s) for message, sent_s in self._waiting.values()]

    def take_lost(self) -> int:
        """The number of poses since the last call that the caller hears nothing of, and that are not sent again."""
        lost = self._open - len(self._waiting) + self._replaced_at_last
        self._open, self._replaced_at_last = len(self._waiting), 0
        return lost


def _with_time_left(message: rendering_pb2.RenderStreamRequest, sent_s: float) -> rendering_pb2.RenderStreamRequest:
    if not message.HasField("timeout_ms"):
        return message
    again = rendering_pb2.RenderStreamRequest()
    again.CopyFrom(message)
    again.timeout_ms = max(message.timeout_ms - 1000.0 * (time.monotonic() - sent_s), _LEAST_TIMEOUT_MS)
    return again
