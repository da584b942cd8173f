"""Streams of frames over WebSocket, and the streams that are open."""

from __future__ import annotations

import asyncio
import contextlib
import time
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import APIRouter, Query, WebSocket, WebSocketDisconnect
from pydantic import Field, FiniteFloat, TypeAdapter

from ultragray.contract import described
from ultragray.errors import InvalidArgument, UltragrayError
from ultragray.geometry.probe import FloatArray
from ultragray.rendering.settings import RenderSettings, settings_used
from ultragray_service.access.credentials import STREAM_PROTOCOL
from ultragray_service.core.frames import FrameHeader
from ultragray_service.core.open_streams import StreamAnswer, StreamSummary, Watcher
from ultragray_service.core.streams import FrameStream, Message, SceneSettings, StreamMode
from ultragray_service.errors import Refusal, statuses_of
from ultragray_service.http.bodies import StreamMessage, adapter_of, read_json
from ultragray_service.http.dependencies import SceneName, ServiceDep, problems
from ultragray_service.http.problems import problem_response
from ultragray_service.http.protocol import HAND_OVER
from ultragray_service.service import Service
from ultragray_workers.errors import Draining

_ALIGNMENT = 8  # so that a client may look at float32 pixels where they lie


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What every message of the service begins with."""

    sequence: int = described("Of the message that it answers.")
    client_time_ms: float | None = described("Likewise.")
    dropped: int = described("Poses that newer ones replaced since the answer before.")


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameMessage(FrameHeader, Answer):
    """The JSON before the pixels of a frame."""


@dataclass(frozen=True, kw_only=True)
class RefusalMessage(Answer):
    """The text message in place of a frame."""

    error: Refusal


def frame_bytes(answer: StreamAnswer) -> bytes:
    """A frame as one binary message: the length of the JSON that follows (uint32, little endian), the JSON, the data.

    Spaces at the end of the JSON let the data begin at a multiple of 8 bytes.
    """
    assert not isinstance(answer.outcome, UltragrayError)
    header: bytes = adapter_of(FrameMessage).dump_json(
        FrameMessage.of(
            answer.outcome,
            **vars(settings_used(answer.outcome.settings)),
            sequence=answer.sequence,
            client_time_ms=answer.client_time,
            dropped=answer.dropped,
        )
    )
    header += b" " * (-(4 + len(header)) % _ALIGNMENT)
    return len(header).to_bytes(4, "little") + header + answer.outcome.data


def refusal_text(answer: StreamAnswer) -> str:
    assert isinstance(answer.outcome, UltragrayError)
    message = RefusalMessage(
        sequence=answer.sequence,
        client_time_ms=answer.client_time,
        dropped=answer.dropped,
        error=Refusal.of(answer.outcome),
    )
    text: bytes = adapter_of(RefusalMessage).dump_json(message)
    return text.decode()


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
        service.life.require_serving()
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
            await FrameStream(
                service.rendering, _WebSocketTransport(websocket, scene), (scene, RenderSettings()), noted
            ).run()
    except WebSocketDisconnect:
        pass
    except Draining as error:
        status = error.reason
        await websocket.close(_SERVICE_RESTART, error.reason)
    finally:
        service.metrics.count_request("websocket", _ROUTE, status, time.perf_counter() - started)


def check_subprotocols(offered: list[str]) -> None:
    if offered and STREAM_PROTOCOL not in offered:
        raise InvalidArgument(
            f"Sec-WebSocket-Protocol must offer {STREAM_PROTOCOL}, also beside a key", field="Sec-WebSocket-Protocol"
        )


class _Message:
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
    destination = None

    def __init__(self, websocket: WebSocket, scene: str) -> None:
        self._websocket = websocket
        self._scene = scene

    async def receive(self) -> _Message | _Unreadable:
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

    async def send(self, answer: StreamAnswer) -> None:
        await self._websocket.send({"type": "websocket.send", **_contents(answer)})

    async def hand_over(self, answer: StreamAnswer) -> None:
        await self._websocket.send({"type": "websocket.send", HAND_OVER: True, **_contents(answer)})


def _contents(answer: StreamAnswer) -> dict[str, Any]:
    if isinstance(answer.outcome, UltragrayError):
        return {"text": refusal_text(answer)}
    return {"bytes": frame_bytes(answer)}


streams_router = APIRouter(prefix="/v1/streams", tags=["streams"])

_STREAMS_ROUTE = "/v1/streams/{stream}/watch"
_ENDED, _SERVICE_RESTART = 1000, 1012  # RFC 6455's registry of close codes

SceneFilter = Annotated[str | None, Query(description="Only streams whose newest frame is of this scene.")]


@dataclass(frozen=True)
class StreamList:
    """Open streams."""

    streams: list[StreamSummary] = described("The oldest first.")


@streams_router.get("", responses=problems(401, 422))
async def list_streams(service: ServiceDep, scene: SceneFilter = None) -> StreamList:
    """The streams that are open at this service: the caller's own, of an admin everybody's.

    WebSockets, calls of RenderStream and connections of OpenIGTLink, each with its rates and its newest pose. Where
    several services answer at one address, these are the streams of the one that answers.
    """
    return StreamList(service.streams.seen(scene))


@streams_router.websocket("/{stream}/watch")
async def watch(websocket: WebSocket, stream: str) -> None:
    """Shows a stream as its client sees it: the newest answer each time the watcher has taken the one before."""
    service: Service = websocket.app.state.service
    started = time.perf_counter()
    place = ExitStack()
    try:
        offered = websocket.scope["subprotocols"]
        check_subprotocols(offered)
        service.life.require_serving()
        place.enter_context(service.limits.stream())
        watcher = place.enter_context(service.streams.get(stream).watched())
    except UltragrayError as error:
        place.close()
        await websocket.send_denial_response(problem_response(error))
        service.metrics.count_request(
            "websocket", _STREAMS_ROUTE, str(statuses_of(error).http), time.perf_counter() - started
        )
        return
    status = "closed"
    try:
        with place:
            await websocket.accept(STREAM_PROTOCOL if STREAM_PROTOCOL in offered else None)
            status = await _show(service, websocket, watcher)
    except WebSocketDisconnect:
        pass
    finally:
        service.metrics.count_request("websocket", _STREAMS_ROUTE, status, time.perf_counter() - started)


async def _show(service: Service, websocket: WebSocket, watcher: Watcher) -> str:
    """Until the stream ends, the watcher goes, or the service stops; how it ended."""
    showing = asyncio.ensure_future(_pass_on(websocket, watcher))
    gone = asyncio.ensure_future(_until_gone(websocket))
    stopping = asyncio.ensure_future(service.life.draining.wait())
    tasks = {showing, gone, stopping}
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        if gone.done():
            return "closed"
        if showing.done():
            showing.result()
            await websocket.close(_ENDED, "STREAM_ENDED")
            return "closed"
        await websocket.close(_SERVICE_RESTART, Draining.reason)
        return Draining.reason
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _pass_on(websocket: WebSocket, watcher: Watcher) -> None:
    while (answer := await watcher.next()) is not None:
        if isinstance(answer.outcome, UltragrayError):
            await websocket.send({"type": "websocket.send", "text": refusal_text(answer)})
        else:
            await websocket.send({"type": "websocket.send", HAND_OVER: True, "bytes": frame_bytes(answer)})


async def _until_gone(websocket: WebSocket) -> None:
    """Reads what the watcher sends, which means nothing, until it closes."""
    with contextlib.suppress(RuntimeError):
        while (await websocket.receive())["type"] != "websocket.disconnect":
            pass
