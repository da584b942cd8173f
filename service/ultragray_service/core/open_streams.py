"""Streams that are open at this service, and who watches them."""

from __future__ import annotations

import asyncio
import secrets
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Literal

from ultragray.contract import described
from ultragray.errors import UltragrayError
from ultragray.geometry.motion import Prediction
from ultragray.learn.localization.pixels import EncodedFrame
from ultragray.rendering.preview import Preview
from ultragray_service.access.principals import Principal, Role, acting, caller
from ultragray_service.core.clocks import ClockOffset
from ultragray_service.core.poses import MatrixRows
from ultragray_service.errors import StreamNotFound
from ultragray_workers.pool.messages import RenderResult


@dataclass(frozen=True, eq=False)
class StreamAnswer:
    """A frame, or why there is none."""

    sequence: int
    client_time: float | None
    outcome: RenderResult | UltragrayError
    dropped: int = 0  # poses that were replaced since the answer before
    prediction: Prediction | None = None  # how the pose of the frame was foretold
    preview: Preview | None = None  # how real frames corrected the frame
    measured_s: float | None = None  # client_time in seconds
    clock: ClockOffset | None = None  # of the client, as it was known when the answer was sent

    def age_ms(self, at_s: float) -> float | None:
        """The age of the pose at a time of the service, s; None: not known."""
        if self.measured_s is None or self.clock is None:
            return None
        return round(1e3 * (at_s - self.measured_s) + self.clock.offset_ms, 3)


# The streams that are open at this service, and who watches them.
# client ── poses ──► stream ── frames ──► client │ note ▼ OpenStream ── the newest answer ──► watchers
# A watcher holds at most one answer, the newest: one that is slow misses some, and never delays the stream.
Door = Literal["websocket", "grpc", "openigtlink"]

MAX_NAME = 100  # characters
_RATE_S = 2.0  # over which rates are taken


@dataclass(frozen=True, kw_only=True)
class StreamSummary:
    """A stream that is open, as those who may watch it see it."""

    id: str
    name: str = described("As its client calls itself, else its user agent or device; may be empty.")
    door: Door = described("What it came through.")
    client: str = described("Its address and port.")
    owner: str = described("Whose it is.")
    scene: str | None = described("Of the newest frame; null: none yet.")
    opened_at: str = described("ISO 8601, UTC.")
    age_s: float = described("Since then.")
    idle_s: float = described("Since its newest pose came; since it was opened where none has come.")
    poses: int = described("That have come.")
    frames: int = described("That were answered.")
    refused: int = described("Messages that got no frame, because of an error.")
    dropped: int = described("Poses that newer ones replaced.")
    poses_per_s: float = described("In the last 2 s.")
    frames_per_s: float = described("Likewise.")
    pose: MatrixRows | None = described("Of the newest frame.")
    watchers: int


# Takes a real frame, by the time that it has, and how old it is: of either one is known. Raises InvalidArgument.
TakeReal = Callable[[EncodedFrame, float | None, float | None], Awaitable[None]]


class _Rate:
    def __init__(self) -> None:
        self._times: deque[float] = deque()

    def count(self) -> None:
        self._times.append(time.monotonic())
        self._forget()

    def per_s(self) -> float:
        self._forget()
        return round(len(self._times) / _RATE_S, 1)

    def _forget(self) -> None:
        oldest = time.monotonic() - _RATE_S
        while self._times and self._times[0] < oldest:
            self._times.popleft()


class Watcher:
    """Takes the answers of one stream, as far as it gets on."""

    def __init__(self) -> None:
        self._newest: StreamAnswer | None = None
        self._ended = False
        self._changed = asyncio.Event()

    def offer(self, answer: StreamAnswer) -> None:
        self._newest = answer
        self._changed.set()

    def end(self) -> None:
        self._ended = True
        self._changed.set()

    async def next(self) -> StreamAnswer | None:
        """The newest answer, once there is one that was not taken; None after the last."""
        await self._changed.wait()
        self._changed.clear()
        answer, self._newest = self._newest, None
        if self._ended:
            self._changed.set()
        return answer


class OpenStream:
    def __init__(self, door: Door = "websocket", name: str = "", owner: str = "", client: str = "") -> None:
        self.id = secrets.token_hex(8)
        self.name = "".join(letter for letter in name if letter.isprintable())[:MAX_NAME]
        self.owner, self._door, self._client = owner, door, client
        self._opened_at = datetime.now(timezone.utc)
        self._opened = self._asked_at = time.monotonic()
        self._poses = self._frames = self._refused = self._dropped = 0
        self._pose_rate, self._frame_rate = _Rate(), _Rate()
        self._newest: RenderResult | None = None
        self._watchers: set[Watcher] = set()
        self.take_real: TakeReal | None = None  # of streams that real frames may correct

    def count_pose(self) -> None:
        self._poses += 1
        self._asked_at = time.monotonic()
        self._pose_rate.count()

    def note(self, answer: StreamAnswer) -> None:
        self._dropped += answer.dropped
        if isinstance(answer.outcome, UltragrayError):
            self._refused += 1
        else:
            self._frames += 1
            self._frame_rate.count()
            self._newest = answer.outcome
        for watcher in self._watchers:
            watcher.offer(answer)

    def summary(self) -> StreamSummary:
        now = time.monotonic()
        return StreamSummary(
            id=self.id,
            name=self.name,
            door=self._door,
            client=self._client,
            owner=self.owner,
            scene=None if self._newest is None else self._newest.scene,
            opened_at=self._opened_at.isoformat(timespec="milliseconds"),
            age_s=round(now - self._opened, 3),
            idle_s=round(now - self._asked_at, 3),
            poses=self._poses,
            frames=self._frames,
            refused=self._refused,
            dropped=self._dropped,
            poses_per_s=self._pose_rate.per_s(),
            frames_per_s=self._frame_rate.per_s(),
            pose=None if self._newest is None else self._newest.poses[0].tolist(),
            watchers=len(self._watchers),
        )

    @contextmanager
    def watched(self) -> Iterator[Watcher]:
        watcher = Watcher()
        self._watchers.add(watcher)
        try:
            yield watcher
        finally:
            self._watchers.discard(watcher)

    def end(self) -> None:
        for watcher in self._watchers:
            watcher.end()


class OpenStreams:
    """All streams of this service; those of other services behind the same address are not among them."""

    def __init__(self) -> None:
        self._streams: dict[str, OpenStream] = {}

    @contextmanager
    def opened(self, door: Door, name: str) -> Iterator[OpenStream]:
        stream = OpenStream(door, name, acting().name, _address_and_port(caller().connection))
        self._streams[stream.id] = stream
        try:
            yield stream
        finally:
            del self._streams[stream.id]
            stream.end()

    def seen(self, scene: str | None = None) -> list[StreamSummary]:
        """The streams that the caller may watch, the oldest first; of a scene: those whose newest frame is of it."""
        summaries = [stream.summary() for stream in self._streams.values() if _may_watch(acting(), stream)]
        return [one for one in summaries if scene is None or one.scene == scene]

    def get(self, stream_id: str) -> OpenStream:
        stream = self._streams.get(stream_id)
        if stream is None or not _may_watch(acting(), stream):
            raise StreamNotFound(f"there is no open stream {stream_id[:MAX_NAME]!r}", field="stream")
        return stream


def _may_watch(principal: Principal, stream: OpenStream) -> bool:
    return principal.role is Role.ADMIN or principal.name == stream.owner


def _address_and_port(connection: str) -> str:
    return connection.removeprefix("ipv4:").removeprefix("ipv6:").replace("%5B", "[").replace("%5D", "]")
