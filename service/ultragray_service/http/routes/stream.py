"""The WebSocket: poses in, frames out."""

from __future__ import annotations

import asyncio
import time
from urllib.parse import urlsplit

from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from pydantic import ValidationError

from ultragray.contract import under
from ultragray.errors import InvalidArgument, UltragrayError
from ultragray.settings import Encoding, Resolved
from ultragray_workers.errors import Draining

from ...auth import STREAM_PROTOCOL
from ...core.pose_stream import Answered, Asked, PoseStream
from ...core.state import Service
from ...errors import OriginRefused, statuses_of
from ..deps import SceneName
from ..problems import invalid_argument, problem_response
from ..render_body import asked_settings, checked_pose
from ..stream_schemas import StreamMessage, StreamSettings, error_text, frame_bytes, message_numbers

router = APIRouter(prefix="/v1/scenes", tags=["render"])

_ROUTE = "/v1/scenes/{scene}/stream"
_SERVICE_RESTART = 1012  # RFC 6455's registry of close codes


@router.websocket("/{scene}/stream")
async def stream(websocket: WebSocket, scene: SceneName) -> None:
    """Poses in, frames out, in the order of the poses."""
    service: Service = websocket.app.state.service
    started = time.perf_counter()
    try:
        _check_origin(websocket, service.settings.cors_origins)
        _check_subprotocols(websocket.scope["subprotocols"])
        service.require_serving()
        await service.catalog.header(scene)
    except UltragrayError as error:
        await websocket.send_denial_response(problem_response(error))
        service.metrics.count_request("websocket", _ROUTE, str(statuses_of(error).http), time.perf_counter() - started)
        return
    await websocket.accept(STREAM_PROTOCOL if STREAM_PROTOCOL in websocket.scope["subprotocols"] else None)
    status = "closed"
    try:
        await _WebSocketStream(service, websocket, scene).run()
    except WebSocketDisconnect:
        pass
    except Draining as error:
        status = error.reason
        await websocket.close(_SERVICE_RESTART, error.reason)
    finally:
        service.metrics.count_request("websocket", _ROUTE, status, time.perf_counter() - started)


def _check_origin(websocket: WebSocket, allowed: tuple[str, ...]) -> None:
    """Raises OriginRefused for a page of another site: browsers let any page open a WebSocket to anywhere."""
    origin = websocket.headers.get("origin")
    if origin is None or "*" in allowed or origin in allowed:
        return
    try:
        host = urlsplit(origin).netloc
    except ValueError:
        host = None
    if host != websocket.headers.get("host"):
        raise OriginRefused(
            f"pages of {origin} may not open streams; allow them with ULTRAGRAY_CORS_ORIGINS", field="Origin"
        )


def _check_subprotocols(offered: list[str]) -> None:
    """Raises InvalidArgument for an offer without the one that is spoken: browsers hang up without it."""
    if offered and STREAM_PROTOCOL not in offered:
        raise InvalidArgument(
            f"Sec-WebSocket-Protocol must offer {STREAM_PROTOCOL}, also beside a key", field="Sec-WebSocket-Protocol"
        )


class _WebSocketStream:
    """One connection."""

    def __init__(self, service: Service, websocket: WebSocket, scene: str) -> None:
        self._service = service
        self._websocket = websocket
        self._scene = scene
        self._settings: Resolved | None = None
        self._has_defaults = True  # until the client sends settings

    async def run(self) -> None:
        """Until the client goes. Raises WebSocketDisconnect, Draining."""
        stream = PoseStream(self._service)

        async def read() -> None:
            message = await self._receive(stream)
            stream.mode = message.stream_mode()
            while True:
                await self._take(message, stream)
                await asyncio.sleep(0)  # reading does not wait while the buffer is full: others get their turn
                message = await self._receive(stream)

        await stream.run(read, self._write)

    async def _receive(self, stream: PoseStream) -> StreamMessage:
        """The next message that can be read; others are refused. Raises WebSocketDisconnect."""
        while True:
            received = await self._websocket.receive()
            if received["type"] == "websocket.disconnect":
                raise WebSocketDisconnect(received.get("code", 1005))
            try:
                if received.get("text") is None:
                    raise InvalidArgument("messages must be JSON in text frames, got a binary one")
                return StreamMessage.model_validate_json(received["text"])
            except ValidationError as error:
                sequence, client_time_ms = message_numbers(received["text"])
                await stream.refuse(sequence, client_time_ms, invalid_argument(error.errors(include_url=False)[0]))
            except InvalidArgument as error:
                await stream.refuse(0, None, error)

    async def _take(self, message: StreamMessage, stream: PoseStream) -> None:
        try:
            if message.settings is not None:
                self._has_defaults = False
                self._settings = await self._plan(message.settings)
            if message.pose is None:
                return
            if self._settings is None:
                if not self._has_defaults:
                    raise InvalidArgument("settings were refused, and none are known yet", field="settings")
                self._settings = await self._plan(StreamSettings())
            asked = Asked(
                sequence=message.sequence,
                client_time=message.client_time_ms,
                scene=self._scene,
                settings=self._settings,
                pose=checked_pose("pose", message.pose),
                deadline=self._service.planner.deadline(
                    None if message.timeout_ms is None else message.timeout_ms / 1000.0
                ),
            )
        except UltragrayError as error:
            await stream.refuse(message.sequence, message.client_time_ms, error)
        else:
            await stream.ask(asked)

    async def _plan(self, settings: StreamSettings) -> Resolved:
        with under("settings"):
            return await self._service.planner.resolve(
                self._scene, asked_settings(settings), Encoding(settings.encoding)
            )

    async def _write(self, answered: Answered) -> None:
        if isinstance(answered.outcome, UltragrayError):
            await self._websocket.send_text(error_text(answered, answered.outcome))
        else:
            await self._websocket.send_bytes(frame_bytes(answered, answered.outcome))
