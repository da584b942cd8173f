"""Parameters and error answers that routes share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import Depends, Path
from starlette.requests import HTTPConnection

from ultragray_service.core.state import Service
from ultragray_service.http.problems import PROBLEM_TYPE, Problem


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
    """The documentation of error answers, for `responses=`; `members`: of the document, beside those of Problem.

    Whoever needs a key (401) has limits (429).
    """
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
