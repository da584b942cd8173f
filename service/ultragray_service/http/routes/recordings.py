"""Recordings: begun, added to frame by frame or over a WebSocket, finished as data sets, deleted."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from starlette.requests import Request

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray_service.core.recordings import IncomingFrame, RecordingAnswer, RecordingView, RefusedFrame, record
from ultragray_service.errors import Refusal, UnsupportedMediaType
from ultragray_service.http.bodies import adapter_of, body_schema, number_of_frame, read_incoming_frame, read_json_body
from ultragray_service.http.dependencies import BINARY, ServiceDep, problems, require_uncompressed
from ultragray_service.http.routes.datasets import DatasetName, Private
from ultragray_service.http.routes.streams import serve_websocket
from ultragray_service.service import Service
from ultragray_workers.datasets.recording import RecordingSettings
from ultragray_workers.datasets.store import DatasetRecord
from ultragray_workers.errors import Draining

router = APIRouter(prefix="/v1/recordings", tags=["datasets"])

FRAME_TYPE = "application/octet-stream"
_REFUSED = 1008  # RFC 6455's registry of close codes
_FRAME: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "The length of the JSON that follows (uint32, little endian), a FrameHead as JSON, and the "
        "image: rows along depth, columns across scan lines, not scan-converted; grey pixels of 8 bits row by row, or "
        "a PNG file.",
        "content": {FRAME_TYPE: BINARY},
    }
}


@router.put(
    "/{dataset}",
    openapi_extra=body_schema(RecordingSettings),
    responses=problems(401, 403, 409, 413, 415, 422, 429, 503),
)
async def begin_recording(
    request: Request, service: ServiceDep, dataset: DatasetName, private: Private = False
) -> RecordingView:
    """Begins a recording, a dataset that is still open; of one that was begun with these settings, how far it is."""
    service.life.require_serving()
    settings = await read_json_body(request, RecordingSettings)
    return await service.recordings.begin(dataset, settings, private=private)


@router.get("/{dataset}", responses=problems(401, 404, 422, 503))
async def get_recording(service: ServiceDep, dataset: DatasetName) -> RecordingView:
    """How far a recording is."""
    return await service.recordings.get(dataset)


@router.post(
    "/{dataset}/frames", openapi_extra=_FRAME, responses=problems(401, 403, 404, 409, 413, 415, 422, 429, 503, 507)
)
async def add_frame(request: Request, service: ServiceDep, dataset: DatasetName) -> RecordingView:
    """Adds a frame. It is stored when the answer comes; one that is sent again though it is stored is left out."""
    service.life.require_serving()
    require_uncompressed(request)
    content_type = request.headers.get("content-type", FRAME_TYPE)
    if content_type != FRAME_TYPE:
        raise UnsupportedMediaType(
            f"Content-Type must be {FRAME_TYPE}, got {content_type[:200]!r}", field="Content-Type"
        )
    async with service.recordings.stream(dataset) as stream:
        await stream.put(read_incoming_frame(await request.body()))
        return await stream.stored()


@router.post("/{dataset}:finish", responses=problems(401, 403, 404, 409, 413, 422, 429, 500, 503, 504, 507))
async def finish_recording(service: ServiceDep, dataset: DatasetName) -> DatasetRecord:
    """Makes a recording a dataset, checked as an upload is. Every fifth frame, from the third, is held out.

    Where it is one already, the dataset again.
    """
    service.life.require_serving()
    return service.datasets.with_owner(await service.recordings.finish(dataset))


@router.delete("/{dataset}", status_code=204, responses=problems(401, 403, 404, 409, 422, 503))
async def delete_recording(service: ServiceDep, dataset: DatasetName) -> None:
    """Deletes a recording that no job follows, with its frames."""
    await service.recordings.delete(dataset)


@router.websocket("/{dataset}/stream")
async def record_frames(websocket: WebSocket, dataset: str) -> None:
    """Frames in, each a binary message as POST takes it; a RecordingAnswer as text first, and whenever more is stored.

    An empty text message ends the recording of this client: after a last answer the service closes.
    """
    service: Service = websocket.app.state.service

    async def enter(place: ExitStack) -> None:
        await service.recordings.get(dataset)
        place.enter_context(service.limits.stream())

    async def receive() -> IncomingFrame | RefusedFrame | None:
        received = await websocket.receive()
        if received["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(received.get("code", 1005))
        if received.get("text") == "":
            return None
        if (body := received.get("bytes")) is None:
            error = InvalidArgument("messages must be binary, or an empty text at the end", field="body")
            return RefusedFrame(None, error)
        try:
            return read_incoming_frame(body)
        except InvalidArgument as error:
            return RefusedFrame(number_of_frame(body), error)

    async def send(answer: RecordingAnswer) -> None:
        await websocket.send_text(adapter_of(RecordingAnswer).dump_json(answer).decode())

    async def answer(_: None) -> None:
        try:
            async with service.recordings.stream(dataset) as stream:
                await record(stream, receive, send, service.life.draining)
            await websocket.close()
        except Draining:
            raise
        except UltragrayError as error:
            await websocket.send_text(adapter_of(Refusal).dump_json(Refusal.of(error)).decode())
            await websocket.close(_REFUSED, error.reason)

    await serve_websocket(websocket, "/v1/recordings/{dataset}/stream", enter, answer)
