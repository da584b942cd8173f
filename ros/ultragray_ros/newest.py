"""Frames of the newest pose over a `latest` stream of the service, and a log of what goes wrong. Free of ROS."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from ultragray_client import Client, Frame, FrameStream, PoseLike, RenderSettings
from ultragray_client.errors import ClientError, DeadlineExceeded

Tag = TypeVar("Tag")


@dataclass(frozen=True)
class _Request(Generic[Tag]):
    pose: PoseLike
    tag: Tag
    arrived_ns: int  # of time.monotonic_ns(), likewise:
    measured_ns: int
    replaced: int  # poses whose place it took


class NewestFrames(Generic[Tag]):
    """A thread that renders one pose at a time: the newest, which takes the place of one that still waits.

    `take` gets each frame with the tag of its pose and the number of poses that it replaced; `tell` what went wrong in
    its place. Both are called by that thread. A stream that is over is followed by another one for the next pose.
    """

    def __init__(
        self,
        client: Client,
        scene: str,
        settings: RenderSettings,
        *,
        timeout_s: float,
        seen_after_ms: float | None = None,
        take: Callable[[Frame, Tag, int], None],
        tell: Callable[[ClientError], None],
    ) -> None:
        """`timeout_s`: a frame that is older, from the arrival of its pose, is told as DeadlineExceeded.

        `seen_after_ms`: as of `Client.stream`.
        """
        self._client, self._timeout_s, self._take, self._tell = client, timeout_s, take, tell
        self._seen_after_ms = seen_after_ms
        self._wanted = (scene, settings)
        self._changed = threading.Condition()
        self._waiting: _Request[Tag] | None = None
        self._closed = False
        self._stream: FrameStream | None = None
        self._streamed: tuple[str, RenderSettings] | None = None  # what the stream was opened for
        self._thread = threading.Thread(target=self._run, name="ultragray-newest", daemon=True)
        self._thread.start()

    def render(self, pose: PoseLike, tag: Tag, age_s: float = 0.0) -> None:
        """Ask for the frame of a pose; `age_s`: from its stamp to now. One that cannot be is taken for 0."""
        now_ns = time.monotonic_ns()
        measured_ns = now_ns - round(1e9 * age_s) if 0.0 <= age_s < self._timeout_s else now_ns
        with self._changed:
            replaced = 0 if self._waiting is None else self._waiting.replaced + 1
            self._waiting = _Request(pose, tag, now_ns, measured_ns, replaced)
            self._changed.notify()

    def change(self, scene: str, settings: RenderSettings) -> None:
        """Render the next pose in another scene, or with other settings."""
        with self._changed:
            self._wanted = (scene, settings)

    def close(self) -> None:
        """End the thread; the pose that it works on gets no frame."""
        with self._changed:
            self._closed = True
            stream = self._stream
            self._changed.notify()
        if stream is not None:
            stream.__exit__()  # else the thread would wait for the frame
        self._thread.join()

    def _run(self) -> None:
        while (request := self._next()) is not None:
            try:
                frame = self._frame(request)
            except ClientError as error:
                if not self._closed:
                    self._tell(error)
            else:
                self._take(frame, request.tag, request.replaced)
        self._end_stream()

    def _next(self) -> _Request[Tag] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._closed)
            request, self._waiting = self._waiting, None
            return None if self._closed else request

    def _frame(self, request: _Request[Tag]) -> Frame:
        left_s = self._left_s(request)
        stream = self._open_stream()
        try:
            stream.send(request.pose, timeout_s=left_s, measured_ns=request.measured_ns)
            frame = stream.receive()
        except ClientError as error:
            if not error.sequence:  # it is about the stream, not about this pose
                self._end_stream()
            raise
        self._left_s(request)
        return frame

    def _left_s(self, request: _Request[Tag]) -> float:
        """What is left of the time of a pose. Raises DeadlineExceeded where there is none."""
        age_s = (time.monotonic_ns() - request.arrived_ns) / 1e9
        if age_s >= self._timeout_s:
            raise DeadlineExceeded(f"the frame is {age_s:.2f} s behind its pose, more than {self._timeout_s:g} s")
        return self._timeout_s - age_s

    def _open_stream(self) -> FrameStream:
        with self._changed:
            wanted = self._wanted
        if self._stream is not None and self._streamed == wanted:
            return self._stream
        self._end_stream()
        scene, settings = wanted
        # reconnect_s=0: a service that is away is told at once, and the next pose asks again
        stream = self._client.stream(scene, settings, mode="latest", reconnect_s=0.0, seen_after_ms=self._seen_after_ms)
        with self._changed:
            self._stream, self._streamed = stream, wanted
            if self._closed:  # too late for `close` to see it
                stream.__exit__()
        return stream

    def _end_stream(self) -> None:
        with self._changed:
            stream, self._stream, self._streamed = self._stream, None, None
        if stream is not None:
            stream.__exit__()


# Problems in the log: of each kind one in a while, with the number of those that were left out. Free of ROS.


PERIOD_S = 5.0


class Problems:
    """Passes on what goes wrong, of each reason at most one sentence in PERIOD_S. Threads may share it."""

    def __init__(self, warn: Callable[[str], object]) -> None:
        self._warn = warn
        self._lock = threading.Lock()
        self._told_at: dict[str, float] = {}  # time.monotonic() by reason
        self._left_out: dict[str, int] = {}

    def tell(self, reason: str, sentence: str) -> None:
        """A problem; `reason` is its kind, such as SCENE_NOT_FOUND."""
        now = time.monotonic()
        with self._lock:
            if now - self._told_at.get(reason, -PERIOD_S) < PERIOD_S:
                self._left_out[reason] = self._left_out.get(reason, 0) + 1
                return
            self._told_at[reason] = now
            left_out = self._left_out.pop(reason, 0)
        self._warn(f"{reason}: {sentence}" + (f" ({left_out} more like it since)" if left_out else ""))
