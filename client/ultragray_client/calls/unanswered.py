"""The poses of a stream that have no answer yet, for when its connection is lost."""

from __future__ import annotations

import time

from ultragray_proto.v1 import rendering_pb2

_LEAST_TIMEOUT_MS = 1e-3  # of a pose whose time has passed: the service tells that it came too late


class Unanswered:
    """The poses that another connection is asked for: all without an answer, of a latest stream the newest alone."""

    def __init__(self, *, newest_alone: bool) -> None:
        self._newest_alone = newest_alone
        self._waiting: dict[int, tuple[rendering_pb2.RenderStreamRequest, float]] = {}  # by sequence, with send times
        self._open = 0  # poses of which nothing was told: no answer, and not that a newer one took their place

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

    def answered(self, message: rendering_pb2.Frame) -> None:
        """A frame came, or why there is none; with the number of poses that newer ones replaced in the service."""
        self._open -= message.dropped + (1 if message.sequence else 0)  # 0: of the settings
        self._waiting.pop(message.sequence, None)

    def again(self) -> list[rendering_pb2.RenderStreamRequest]:
        """The poses to send over another connection, in their order, each with what is left of its time."""
        return [_with_time_left(message, sent) for message, sent in self._waiting.values()]

    def take_lost(self) -> int:
        """The number of poses that nothing will be told of, because they are not sent again; from now on they count no
        more.
        """
        lost, self._open = self._open - len(self._waiting), len(self._waiting)
        return lost


def _with_time_left(message: rendering_pb2.RenderStreamRequest, sent: float) -> rendering_pb2.RenderStreamRequest:
    if not message.HasField("timeout_ms"):
        return message
    again = rendering_pb2.RenderStreamRequest()
    again.CopyFrom(message)
    again.timeout_ms = max(message.timeout_ms - 1000.0 * (time.monotonic() - sent), _LEAST_TIMEOUT_MS)
    return again
