"""The WebSocket: poses in, frames out."""

from __future__ import annotations

import asyncio
import time
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import APIRouter, Query, WebSocket, WebSocketDisconnect
from pydantic import Field, FiniteFloat, TypeAdapter

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray.probe import FloatArray
from ultragray.settings import RenderSettings
from ultragray_service.access.credentials import STREAM_PROTOCOL
from ultragray_service.core.state import Service
from ultragray_service.core.streams.answers import Answered
from ultragray_service.core.streams.pose_stream import StreamMode
from ultragray_service.core.streams.stream import FrameStream, Message, SceneSettings
from ultragray_service.errors import statuses_of
from ultragray_service.http.deps import SceneName
from ultragray_service.http.problems import problem_response
from ultragray_service.http.prompt_websocket import HAND_OVER
from ultragray_service.http.reading.bodies import StreamMessage
from ultragray_service.http.reading.json_body import read_json
from ultragray_service.http.stream_messages import frame_bytes, refusal_text
from ultragray_workers.errors import Draining

router = APIRouter(prefix="/v1/scenes", tags=["render"])

_ROUTE = "/v1/scenes/{scene}/stream"
_SERVICE_RESTART = 1012  # RFC 6455's registry of close codes

StreamName = Annotated[str, Query(description="Of the stream, for those who watch it.")]


@router.websocket("/{scene}/stream")
async def stream(websocket: WebSocket, scene: SceneName, name: StreamName = "") -> None:
    """Poses in, frames out, in the order of the poses."""
    service: Service = websocket.app.state.service
    started = time.perf_counter()
    place = ExitStack()
    try:
        check_subprotocols(websocket.scope["subprotocols"])
        service.require_serving()
        await service.catalog.header(scene)
        place.enter_context(service.limits.stream())
        noted = place.enter_context(
            service.streams.opened("websocket", name or websocket.headers.get("user-agent", ""))
        )
    except UltragrayError as error:
        await websocket.send_denial_response(problem_response(error))
        service.metrics.count_request("websocket", _ROUTE, str(statuses_of(error).http), time.perf_counter() - started)
        return
    status = "closed"
    try:
        with place:
            await websocket.accept(STREAM_PROTOCOL if STREAM_PROTOCOL in websocket.scope["subprotocols"] else None)
            await FrameStream(service, _WebSocketTransport(websocket, scene), (scene, RenderSettings()), noted).run()
    except WebSocketDisconnect:
        pass
    except Draining as error:
        status = error.reason
        await websocket.close(_SERVICE_RESTART, error.reason)
    finally:
        service.metrics.count_request("websocket", _ROUTE, status, time.perf_counter() - started)


def check_subprotocols(offered: list[str]) -> None:
    """Raises InvalidArgument for an offer without the one that is spoken: browsers hang up without it."""
    if offered and STREAM_PROTOCOL not in offered:
        raise InvalidArgument(
            f"Sec-WebSocket-Protocol must offer {STREAM_PROTOCOL}, also beside a key", field="Sec-WebSocket-Protocol"
        )


class _Message:
    """A message that could be read."""

    def __init__(self, message: StreamMessage, scene: str) -> None:
        self.sequence = message.sequence
        self.client_time = message.client_time_ms
        self.mode = message.mode
        self.window = message.window
        self.acknowledged = message.acknowledged
        self._message = message
        self._scene = scene

    def settings(self) -> SceneSettings | None:
        return None if self._message.settings is None else (self._scene, self._message.settings)

    @property
    def asks(self) -> bool:
        return self._message.pose is not None

    def pose(self) -> FloatArray:  # [4, 4] mm
        assert self._message.pose is not None
        return self._message.pose.exact("pose")

    def timeout_s(self) -> float | None:
        return None if self._message.timeout_ms is None else self._message.timeout_ms / 1000.0


class _Unreadable:
    """A message that could not: it has its numbers, as far as they can be read, and raises why."""

    def __init__(self, text: str | None, error: UltragrayError) -> None:
        try:
            numbers = _NUMBERS.validate_json(text or "")
        except (ValueError, RecursionError):
            numbers = _Numbers()
        self.sequence, self.client_time = numbers.sequence, numbers.client_time_ms
        self._error = error

    def settings(self) -> SceneSettings | None:
        if (self._error.field or "").startswith("settings"):
            raise self._error
        return None

    asks = True
    window = acknowledged = None

    def pose(self) -> FloatArray:
        raise self._error

    def timeout_s(self) -> float | None:
        return None


@dataclass(frozen=True)
class _Numbers:
    sequence: Annotated[int, Field(ge=0, le=2**64 - 1)] = 0
    client_time_ms: FiniteFloat | None = None


_NUMBERS = TypeAdapter(_Numbers)


class _WebSocketTransport:
    """One connection. Its mode is read from the first message that can be read."""

    destination = None

    def __init__(self, websocket: WebSocket, scene: str) -> None:
        self._websocket = websocket
        self._scene = scene

    async def receive(self) -> _Message | _Unreadable:
        """Raises WebSocketDisconnect."""
        await asyncio.sleep(0)  # reading does not wait while the buffer is full: others get their turn
        received = await self._websocket.receive()
        if received["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(received.get("code", 1005))
        text = received.get("text")
        try:
            if text is None:
                raise InvalidArgument("messages must be JSON in text frames, got a binary one")
            return _Message(read_json(text, StreamMessage), self._scene)
        except UltragrayError as error:
            return _Unreadable(text, error)

    def mode(self, message: Message) -> StreamMode | None:
        return (message.mode or StreamMode.ORDERED) if isinstance(message, _Message) else None

    async def send(self, answered: Answered) -> None:
        await self._websocket.send({"type": "websocket.send", **_contents(answered)})

    async def hand_over(self, answered: Answered) -> None:
        await self._websocket.send({"type": "websocket.send", HAND_OVER: True, **_contents(answered)})


def _contents(answered: Answered) -> dict[str, Any]:
    if isinstance(answered.outcome, UltragrayError):
        return {"text": refusal_text(answered)}
    return {"bytes": frame_bytes(answered)}
