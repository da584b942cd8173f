"""The poses of a stream that have no answer yet, for when its connection is lost."""

from __future__ import annotations

import time

from ultragray_proto.v1 import rendering_pb2

from ..errors import Draining

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

    def sent(self, message: rendering_pb2.RenderStreamRequest) -> None:
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
        return [_with_time_left(message, sent) for message, sent in self._waiting.values()]

    def take_lost(self) -> int:
        """The number of poses since the last call that the caller hears nothing of, and that are not sent again."""
        lost = self._open - len(self._waiting) + self._replaced_at_last
        self._open, self._replaced_at_last = len(self._waiting), 0
        return lost


def _with_time_left(message: rendering_pb2.RenderStreamRequest, sent: float) -> rendering_pb2.RenderStreamRequest:
    if not message.HasField("timeout_ms"):
        return message
    again = rendering_pb2.RenderStreamRequest()
    again.CopyFrom(message)
    again.timeout_ms = max(message.timeout_ms - 1000.0 * (time.monotonic() - sent), _LEAST_TIMEOUT_MS)
    return again
