"""The open streams, and the WebSocket that shows what one of them asks for and gets."""

from __future__ import annotations

import asyncio
import contextlib
import time
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Query, WebSocket, WebSocketDisconnect

from ultragray.contract import described
from ultragray.errors import UltragrayError
from ultragray_service.access.credentials import STREAM_PROTOCOL
from ultragray_service.core.state import Service
from ultragray_service.core.streams.open_streams import StreamSummary, Watcher
from ultragray_service.errors import statuses_of
from ultragray_service.http.deps import ServiceDep, problems
from ultragray_service.http.problems import problem_response
from ultragray_service.http.prompt_websocket import HAND_OVER
from ultragray_service.http.routes.stream import check_subprotocols
from ultragray_service.http.stream_messages import frame_bytes, refusal_text
from ultragray_workers.errors import Draining

router = APIRouter(prefix="/v1/streams", tags=["streams"])

_ROUTE = "/v1/streams/{stream}/watch"
_ENDED, _SERVICE_RESTART = 1000, 1012  # RFC 6455's registry of close codes

SceneFilter = Annotated[str | None, Query(description="Only streams whose newest frame is of this scene.")]


@dataclass(frozen=True)
class StreamList:
    """Open streams."""

    streams: list[StreamSummary] = described("The oldest first.")


@router.get("", responses=problems(401, 422))
async def list_streams(service: ServiceDep, scene: SceneFilter = None) -> StreamList:
    """The streams that are open at this service: the caller's own, of an admin everybody's.

    WebSockets, calls of RenderStream and connections of OpenIGTLink, each with its rates and its newest pose. Where
    several services answer at one address, these are the streams of the one that answers.
    """
    return StreamList(service.streams.seen(scene))


@router.websocket("/{stream}/watch")
async def watch(websocket: WebSocket, stream: str) -> None:
    """Shows a stream as its client sees it: the newest answer each time the watcher has taken the one before."""
    service: Service = websocket.app.state.service
    started = time.perf_counter()
    place = ExitStack()
    try:
        offered = websocket.scope["subprotocols"]
        check_subprotocols(offered)
        service.require_serving()
        place.enter_context(service.limits.stream())
        watcher = place.enter_context(service.streams.get(stream).watched())
    except UltragrayError as error:
        place.close()
        await websocket.send_denial_response(problem_response(error))
        service.metrics.count_request("websocket", _ROUTE, str(statuses_of(error).http), time.perf_counter() - started)
        return
    status = "closed"
    try:
        with place:
            await websocket.accept(STREAM_PROTOCOL if STREAM_PROTOCOL in offered else None)
            status = await _show(service, websocket, watcher)
    except WebSocketDisconnect:
        pass
    finally:
        service.metrics.count_request("websocket", _ROUTE, status, time.perf_counter() - started)


async def _show(service: Service, websocket: WebSocket, watcher: Watcher) -> str:
    """Until the stream ends, the watcher goes, or the service stops; how it ended."""
    showing = asyncio.ensure_future(_pass_on(websocket, watcher))
    gone = asyncio.ensure_future(_until_gone(websocket))
    stopping = asyncio.ensure_future(service.draining.wait())
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
    """Sends answers as the stream's own client gets them, as many as the watcher takes."""
    while (answered := await watcher.next()) is not None:
        if isinstance(answered.outcome, UltragrayError):
            await websocket.send({"type": "websocket.send", "text": refusal_text(answered)})
        else:
            await websocket.send({"type": "websocket.send", HAND_OVER: True, "bytes": frame_bytes(answered)})


async def _until_gone(websocket: WebSocket) -> None:
    """Reads what the watcher sends, which means nothing, until it closes."""
    with contextlib.suppress(RuntimeError):
        while (await websocket.receive())["type"] != "websocket.disconnect":
            pass
