"""What several routes need: the service, documented problems, work that ends with its client, revalidation."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping
from typing import Annotated, Any, TypeVar

import numpy as np
from fastapi import Depends, Path, Query
from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import Response
from starlette.types import Receive

from ultragray_service.core.uploads import Next
from ultragray_service.errors import UnsupportedMediaType
from ultragray_service.http.problems import PROBLEM_TYPE, Problem
from ultragray_service.service import Service
from ultragray_workers.errors import DeadlineExceeded, UploadTooLarge


async def _service(connection: HTTPConnection) -> Service:  # async: FastAPI runs plain functions in a thread
    service = connection.app.state.service
    assert isinstance(service, Service)
    return service


ServiceDep = Annotated[Service, Depends(_service)]
_REFERENCE = "#/components/schemas/{}"
_NAME_MEANS = (
    "Name of the scene: its file name without .ugr. NAME@SHA256, or NAME@ and at least 12 digits of it, asks for that "
    "content alone."
)
SceneName = Annotated[str, Path(description=_NAME_MEANS, examples=["demo"])]
SCENE_NAME = {"description": _NAME_MEANS, "schema": {"type": "string", "title": "Scene", "examples": ["demo"]}}


def problems(*statuses: int, members: Mapping[str, type] | None = None) -> dict[int | str, dict[str, Any]]:
    """The documentation of error answers; `members`: more of the document. Who needs a key (401) has limits (429)."""
    statuses = tuple(sorted({*statuses, 429})) if 401 in statuses else statuses
    schema: dict[str, Any] = {"$ref": _REFERENCE.format(Problem.__name__)}
    if members:
        more = {name: {"$ref": _REFERENCE.format(kind.__name__)} for name, kind in members.items()}
        schema = {"allOf": [schema, {"type": "object", "properties": more, "required": list(more)}]}
    content = {PROBLEM_TYPE: {"schema": schema}}
    return {status: {"description": _MEANINGS[status], "content": content} for status in statuses}


_MEANINGS = {
    401: "No API key, or an unknown one (UNAUTHENTICATED), where the service asks for one.",
    403: "The role of the key does not allow it, or it is somebody else's (PERMISSION_DENIED); the scene lies in the "
    "data folder, which is not the service's (SCENE_READ_ONLY).",
    404: "No such scene, dataset, job, artifact, worker or registration (SCENE_NOT_FOUND, DATASET_NOT_FOUND, "
    "JOB_NOT_FOUND, ARTIFACT_NOT_FOUND, WORKER_NOT_FOUND, REGISTRATION_NOT_FOUND).",
    406: "The Accept header allows no type that can hold the request (NOT_ACCEPTABLE).",
    409: "What is there already, or its state, does not allow it (DATASET_EXISTS, DATASET_IN_USE, SCENE_EXISTS, "
    "REQUEST_ID_CONFLICT, JOB_FINISHED, JOB_NOT_FINISHED, JOB_IN_USE).",
    413: "The body is over the limit (BODY_TOO_LARGE, UPLOAD_TOO_LARGE).",
    415: "The body is of another type than the route takes (UNSUPPORTED_MEDIA_TYPE).",
    422: "A value cannot be used: INVALID_ARGUMENT, INVALID_POSE, INVALID_PROBE, INVALID_IMAGE_SIZE, "
    "UNKNOWN_OUTPUT, TOO_MANY_POSES, FRAME_TOO_COSTLY, SCENE_FILE_INVALID, DATASET_INVALID. `field` names it.",
    429: "Too many frames, uploads or jobs wait (QUEUE_FULL, JOB_QUEUE_FULL), or the key asks for more in a second "
    "than it may (RATE_LIMITED): retry after the seconds of Retry-After. Or it has all that it may (LIMIT_REACHED).",
    500: "Rendering failed (RENDER_FAILED, INTERNAL).",
    501: "The format needs an optional package that the service lacks (EXTRA_MISSING).",
    503: "The service is starting or stopping (NOT_READY, DRAINING), or a bucket does not answer "
    "(STORAGE_UNAVAILABLE); retry after the seconds of Retry-After.",
    504: "The deadline passed before the answer was ready, or an upload came to a halt (DEADLINE_EXCEEDED).",
    507: "The memory or the disk has no room (SCENE_TOO_LARGE, MEMORY_EXCEEDED, STORAGE_FULL).",
}


T = TypeVar("T")


async def finish_or_abandon(work: Coroutine[Any, Any, T], receive: Receive, deadline: float) -> T:
    """The result of `work`, cancelled where the client goes away or the deadline passes.

    `deadline` is in time.monotonic() seconds. The request's body must have been read.
    Raises ClientDisconnect, DeadlineExceeded, and what `work` raises.
    """
    working = asyncio.ensure_future(work)
    leaving = asyncio.ensure_future(_disconnected(receive))
    try:
        timeout_s = max(0.0, deadline - time.monotonic())
        await asyncio.wait({working, leaving}, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            return working.result()
        if leaving.done():
            raise ClientDisconnect
        raise DeadlineExceeded("the deadline passed before the answer was ready")
    finally:
        working.cancel()
        leaving.cancel()


async def blocks_of(request: Request, arrival: Next[Any]) -> AsyncIterator[bytes]:
    """The body as it comes. Raises ClientDisconnect, and what `arrival` raises, see `arrivals`."""
    more = True
    while more:
        message = await arrival(request.receive())
        if message["type"] == "http.disconnect":
            raise ClientDisconnect
        more = message.get("more_body", False)
        yield message.get("body", b"")


def check_upload(request: Request, limit_bytes: int, what: str) -> None:
    """Raise UploadTooLarge where an upload announces too many bytes, UnsupportedMediaType where it is compressed."""
    require_uncompressed(request)
    announced = request.headers.get("content-length", "")
    if announced.isdigit() and int(announced) > limit_bytes:
        raise UploadTooLarge(f"{what} may have at most {limit_bytes} bytes, {announced} were announced", field="body")


def require_uncompressed(request: Request) -> None:
    if request.headers.get("content-encoding", "identity").lower() != "identity":
        raise UnsupportedMediaType("the body must not be compressed", field="Content-Encoding")


async def _disconnected(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


Answers = dict[int | str, dict[str, Any]]
BINARY = {"schema": {"type": "string", "format": "binary"}}
NOT_MODIFIED: Answers = {304: {"description": "It is as the client has it (If-None-Match)."}}
PageToken = Annotated[str, Query(description="next_page_token of the page before.")]


def answer(description: str, *media_types: str, headers: Mapping[str, str] | None = None) -> Answers:
    """The documentation of an answer of bytes, with its headers and their meanings."""
    document: dict[str, Any] = {"description": description, "content": dict.fromkeys(media_types, BINARY)}
    if headers is not None:
        document["headers"] = {
            name: {"description": text, "schema": {"type": "string"}} for name, text in headers.items()
        }
    return {200: document}


async def revalidated(
    request: Request, version: str, make: Callable[[], Awaitable[bytes]], media_type: str
) -> Response:
    """What `make` gives, with `version` (letters, digits, '-') as ETag; 304 where the client has that version."""
    headers = {"ETag": f'"{version}"', "Cache-Control": "private, no-cache"}
    if is_known(request.headers, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    return Response(await make(), media_type=media_type, headers=headers)


def is_known(headers: Headers, tag: str) -> bool:
    """Whether the client has what the ETag names (If-None-Match)."""
    return tag in (known.strip().removeprefix("W/") for known in headers.get("if-none-match", "").split(","))


DEMO_SCENE = "demo"
DEMO_POSITION_MM = {"x": 0.0, "y": 0.0, "z": 0.0}  # of the probe, in the frame of the demo scene
DEMO_QUATERNION = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}

_POSE = {"position_mm": DEMO_POSITION_MM, "quaternion": DEMO_QUATERNION}

RENDER_EXAMPLES: dict[str, Any] = {
    "one frame": {"summary": "One frame, by position and quaternion (image/png by default)", "value": {"pose": _POSE}},
    "matrix": {
        "summary": "One small frame, by matrix",
        "value": {"pose": {"matrix": np.eye(4).tolist()}, "height": 256, "width": 256},
    },
    "batch": {
        "summary": "Two poses 2 mm apart, two outputs (application/x-npz by default)",
        "value": {
            "poses": [_POSE, {**_POSE, "position_mm": {**DEMO_POSITION_MM, "y": 2.0}}],
            "outputs": ["bmode", "transmittance"],
        },
    },
    "another probe": {
        "summary": "One frame with a convex probe",
        "value": {
            "pose": _POSE,
            "probe": {"kind": "convex", "opening_angle_deg": 60.0, "near_mm": 10.0, "far_mm": 60.0},
        },
    },
}

JOB_EXAMPLES: dict[str, Any] = {
    "train": {
        "summary": "Train a scene from an uploaded dataset and serve it",
        "value": {
            "kind": "train",
            "specification": {"dataset": "liver", "scene": "liver-1", "settings": {"steps": 500}},
            "request_id": "liver-1",
        },
    },
    "render": {
        "summary": "A hundred frames about the training poses, as a tar of PNGs",
        "value": {
            "kind": "render",
            "specification": {
                "scene": DEMO_SCENE,
                "sampler": {"kind": "around", "count": 100, "translation_mm": 2.0, "rotation_deg": 5.0, "seed": 0},
                "format": "tar",
            },
        },
    },
}

SLICE_EXAMPLES: dict[str, Any] = {
    "a plane parallel to the skin": {
        "summary": "10 mm deep, 50 x 40 mm (image/png by default)",
        "value": {"origin_mm": [-25, -20, 10], "right": [1, 0, 0], "down": [0, 1, 0], "size_mm": [50, 40]},
    }
}
