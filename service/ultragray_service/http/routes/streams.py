"""Streams of frames over WebSocket, and the streams that are open."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial, partialmethod
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Query, Request, WebSocket, WebSocketDisconnect
from pydantic import Field, FiniteFloat, TypeAdapter

from ultragray.contract import described
from ultragray.errors import InvalidArgument, UltragrayError
from ultragray.geometry.image_size import MAX_IMAGE_SIDE
from ultragray.geometry.motion import Prediction
from ultragray.learn.localization.pixels import EncodedFrame
from ultragray.rendering.preview import Preview
from ultragray.rendering.settings import RenderSettings, settings_used
from ultragray_service.access.credentials import STREAM_PROTOCOL
from ultragray_service.core.clocks import ClockOffset, service_time_s
from ultragray_service.core.open_streams import OpenStream, StreamAnswer, StreamSummary, Watcher
from ultragray_service.core.poses import FrameHeader
from ultragray_service.core.previews import RealFrame
from ultragray_service.core.streams import (
    FrameStream,
    Message,
    StreamMode,
    ahead_s,
    nothing,
    unreadable,
)
from ultragray_service.errors import Refusal, StreamNotFound, statuses_of
from ultragray_service.http.bodies import StreamMessage, adapter_of, message_parts, read_json
from ultragray_service.http.dependencies import SceneName, ServiceDep, problems, require_uncompressed
from ultragray_service.http.problems import problem_response
from ultragray_service.http.protocol import HAND_OVER
from ultragray_service.service import Service
from ultragray_workers.errors import Draining

T = TypeVar("T")
_ALIGNMENT = 8  # so that a client may look at float32 pixels where they lie


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What every message of the service begins with."""

    sequence: int = described("Of the message that it answers.")
    client_time_ms: float | None = described("Likewise.")
    dropped: int = described("Poses that newer ones replaced since the answer before.")
    sent_ms: float = described("When it is sent, by the service's clock, since 1970.")
    clock: ClockOffset | None = described("The client's clock beside the service's; null: not known yet.")
    age_ms: float | None = described(
        "From client_time_ms, when the pose was measured, to sent_ms, across both clocks; null: not known."
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameMessage(FrameHeader, Answer):
    """The JSON before the pixels of a frame."""

    prediction: Prediction | None = described("How its pose was foretold; null: it is as it was sent.")
    preview: Preview | None = described("How real frames of the stream corrected it; null: none did.")


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
            **_beginning(answer),
            prediction=answer.prediction,
            preview=answer.preview,
        )
    )
    header += b" " * (-(4 + len(header)) % _ALIGNMENT)
    return len(header).to_bytes(4, "little") + header + answer.outcome.data


def _beginning(answer: StreamAnswer) -> dict[str, Any]:
    """The fields of an Answer that is sent now."""
    sent_s = service_time_s()
    return {
        "sequence": answer.sequence,
        "client_time_ms": answer.client_time,
        "dropped": answer.dropped,
        "sent_ms": 1e3 * sent_s,
        "clock": answer.clock,
        "age_ms": answer.age_ms(sent_s),
    }


def refusal_text(answer: StreamAnswer) -> str:
    assert isinstance(answer.outcome, UltragrayError)
    message = RefusalMessage(**_beginning(answer), error=Refusal.of(answer.outcome))
    text: bytes = adapter_of(RefusalMessage).dump_json(message)
    return text.decode()


router = APIRouter(prefix="/v1/scenes", tags=["render"])

_ROUTE = "/v1/scenes/{scene}/stream"
_ENDED, _SERVICE_RESTART = 1000, 1012  # RFC 6455's registry of close codes

StreamName = Annotated[str, Query(description="Of the stream, for those who watch it.")]


@router.websocket("/{scene}/stream")
async def stream(websocket: WebSocket, scene: SceneName, name: StreamName = "") -> None:
    """Poses in, frames out, in the order of the poses."""
    service: Service = websocket.app.state.service

    async def enter(place: ExitStack) -> OpenStream:
        await service.catalog.header(scene)
        place.enter_context(service.limits.stream())
        return place.enter_context(service.streams.opened("websocket", name or websocket.headers.get("user-agent", "")))

    async def answer(record: OpenStream) -> None:
        transport = _WebSocketTransport(websocket, scene)
        await FrameStream(service.rendering, transport, (scene, RenderSettings()), record).run()

    await serve_websocket(websocket, _ROUTE, enter, answer)


async def serve_websocket(
    websocket: WebSocket, route: str, enter: Callable[[ExitStack], Awaitable[T]], answer: Callable[[T], Awaitable[None]]
) -> None:
    """Answers a WebSocket that `enter` lets in; what that enters lasts as long. Counts it at its end."""
    service: Service = websocket.app.state.service
    offered = websocket.scope["subprotocols"]
    started, status = time.perf_counter(), "closed"
    try:
        with ExitStack() as place:
            try:
                if offered and STREAM_PROTOCOL not in offered:  # browsers hang up without it
                    raise InvalidArgument(
                        f"Sec-WebSocket-Protocol must offer {STREAM_PROTOCOL}, also beside a key",
                        field="Sec-WebSocket-Protocol",
                    )
                service.life.require_serving()
                entered = await enter(place)
            except UltragrayError as error:
                status = str(statuses_of(error).http)
                await websocket.send_denial_response(problem_response(error))
                return
            await websocket.accept(STREAM_PROTOCOL if offered else None)
            await answer(entered)
    except WebSocketDisconnect:
        pass
    except Draining as error:
        status = error.reason
        await websocket.close(_SERVICE_RESTART, error.reason)
    finally:
        service.metrics.count_request("websocket", route, status, time.perf_counter() - started)


@dataclass(frozen=True)
class _Numbers:
    sequence: Annotated[int, Field(ge=0, le=2**64 - 1)] = 0
    client_time_ms: FiniteFloat | None = None


_NUMBERS = TypeAdapter(_Numbers)


def _message_of(received: str | bytes, scene: str) -> Message:
    text: str | bytes = ""
    try:
        text, image = message_parts(received)
        message = read_json(text, StreamMessage)
        if message.real is None and isinstance(received, bytes):
            raise InvalidArgument("a binary message must tell of the real frame behind it", field="real")
    except UltragrayError as error:
        try:
            numbers = _NUMBERS.validate_json(text)
        except (ValueError, RecursionError):
            numbers = _Numbers()
        of_settings = (error.field or "").startswith("settings")
        return unreadable(error, of_settings=of_settings, sequence=numbers.sequence, client_time=numbers.client_time_ms)
    pose, settings, timeout_ms, predict_ms = message.pose, message.settings, message.timeout_ms, message.predict_ms
    real = message.real
    return Message(
        sequence=message.sequence,
        client_time=message.client_time_ms,
        measured_s=None if message.client_time_ms is None else message.client_time_ms / 1e3,
        mode=lambda: message.mode or StreamMode.ORDERED,
        window=message.window,
        acknowledged=message.acknowledged,
        settings=lambda: None if settings is None else (scene, settings),
        asks=pose is not None,
        pose=nothing if pose is None else partial(pose.exact, "pose"),  # type: ignore[arg-type]  # it asks for none
        timeout_s=lambda: None if timeout_ms is None else timeout_ms / 1000.0,
        ahead_s=lambda: ahead_s(message.client_time_ms, predict_ms, "client_time_ms"),
        real=lambda: (
            None
            if real is None
            else RealFrame(EncodedFrame(image, real.image_height, real.image_width), real.client_time_ms / 1e3)
        ),
        stamps=None if (clock := message.clock) is None else clock.in_seconds(),
    )


class _WebSocketTransport:
    destination = None

    def __init__(self, websocket: WebSocket, scene: str) -> None:
        self._websocket, self._scene = websocket, scene

    async def receive(self) -> Message:
        await asyncio.sleep(0)  # reading does not wait while the buffer is full: others get their turn
        received = await self._websocket.receive()
        if received["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(received.get("code", 1005))
        text: str | None = received.get("text")
        return _message_of(received["bytes"] if text is None else text, self._scene)

    async def send(self, answer: StreamAnswer, *, hand_over: bool = False) -> None:
        is_refusal = isinstance(answer.outcome, UltragrayError)
        contents = {"text": refusal_text(answer)} if is_refusal else {"bytes": frame_bytes(answer)}
        await self._websocket.send({"type": "websocket.send", HAND_OVER: hand_over, **contents})

    hand_over = partialmethod(send, hand_over=True)


streams_router = APIRouter(prefix="/v1/streams", tags=["streams"])

_STREAMS_ROUTE = "/v1/streams/{stream}/watch"

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


Milliseconds = Annotated[FiniteFloat | None, Query()]
Side = Annotated[int | None, Query(ge=1, le=MAX_IMAGE_SIDE, description="Of grey pixels of 8 bits, row by row.")]


@streams_router.post("/{stream}/real-frames", status_code=204, responses=problems(401, 404, 413, 422))
async def put_real_frame(
    service: ServiceDep,
    stream: str,
    request: Request,
    client_time_ms: Milliseconds = None,
    age_ms: Milliseconds = None,
    image_height: Side = None,
    image_width: Side = None,
) -> None:
    """A real frame that has come, late, and not to the program that streams: it corrects the frames of the stream.

    The body is a PNG file, or grey pixels. When the frame was taken tells either `client_time_ms`, by the clock of the
    stream's poses, or `age_ms`, how long ago that was: then the messages of the stream must align the clocks.
    """
    require_uncompressed(request)
    record, data = service.streams.get(stream), await request.body()
    if record.take_real is None:
        raise StreamNotFound(
            "this stream takes no real frames: WebSockets and calls of RenderStream do", field="stream"
        )
    times = (None if time_ms is None else time_ms / 1e3 for time_ms in (client_time_ms, age_ms))
    await record.take_real(EncodedFrame(data, image_height, image_width), *times)


@streams_router.websocket("/{stream}/watch")
async def watch(websocket: WebSocket, stream: str) -> None:
    """Shows a stream as its client sees it: the newest answer each time the watcher has taken the one before."""
    service: Service = websocket.app.state.service

    async def enter(place: ExitStack) -> Watcher:
        place.enter_context(service.limits.stream())
        return place.enter_context(service.streams.get(stream).watched())

    await serve_websocket(websocket, _STREAMS_ROUTE, enter, partial(_show, service, websocket))


async def _show(service: Service, websocket: WebSocket, watcher: Watcher) -> None:
    """Until the stream ends or the watcher goes. Raises Draining where the service stops first."""
    showing = asyncio.ensure_future(_pass_on(websocket, watcher))
    gone = asyncio.ensure_future(_until_gone(websocket))
    stopping = asyncio.ensure_future(service.life.draining.wait())
    tasks = {showing, gone, stopping}
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        if gone.done():
            return
        if not showing.done():
            raise Draining("the service is stopping")
        showing.result()
        await websocket.close(_ENDED, "STREAM_ENDED")
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _pass_on(websocket: WebSocket, watcher: Watcher) -> None:
    transport = _WebSocketTransport(websocket, "")
    while (answer := await watcher.next()) is not None:
        await transport.hand_over(answer)


async def _until_gone(websocket: WebSocket) -> None:
    """Reads what the watcher sends, which means nothing, until it closes."""
    with contextlib.suppress(RuntimeError):
        while (await websocket.receive())["type"] != "websocket.disconnect":
            pass
