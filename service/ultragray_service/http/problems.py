"""Every error as RFC 9457 application/problem+json."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from ultragray.errors import InvalidArgument, InvalidImageSize, InvalidPose, InvalidProbe, UltragrayError, UnknownOutput

from ..errors import MethodNotAllowed, RouteNotFound, statuses_of
from ..logs import request_id

PROBLEM_TYPE = "application/problem+json"

_CLASS_OF_FIELD: dict[str, type[InvalidArgument]] = {
    "pose": InvalidPose,
    "poses": InvalidPose,
    "probe": InvalidProbe,
    "height": InvalidImageSize,
    "width": InvalidImageSize,
    "outputs": UnknownOutput,
}
_PROBE_KINDS = ("linear", "convex", "phased")  # pydantic puts the tag of a union into the path
_SHOWN_INPUT = 60


class Problem(BaseModel):
    """An error (RFC 9457). `reason` is stable; `field` is the path of the value to blame, null if none is."""

    type: str = Field(examples=["urn:ultragray:problem:scene-not-found"])
    title: str = Field(examples=["No such scene"])
    status: int = Field(examples=[404])
    detail: str = Field(examples=["no scene named 'liver'"])
    reason: str = Field(examples=["SCENE_NOT_FOUND"])
    field: str | None = Field(examples=["scene"])
    request_id: str


def problem_response(error: UltragrayError, headers: Mapping[str, str] | None = None) -> Response:
    """The answer that tells a client about `error`."""
    statuses = statuses_of(error)
    document = Problem(
        type=f"urn:ultragray:problem:{error.reason.lower().replace('_', '-')}",
        title=error.title,
        status=statuses.http,
        detail=error.detail,
        reason=error.reason,
        field=error.field,
        request_id=request_id.get(),
    )
    all_headers = dict(headers or {})
    if statuses.retry_after_s is not None:
        all_headers["Retry-After"] = str(statuses.retry_after_s)
    if statuses.http == 401:
        all_headers["WWW-Authenticate"] = "Bearer"
    content = json.dumps(document.model_dump(), ensure_ascii=False)
    return Response(content.encode("utf-8", "replace"), statuses.http, all_headers, PROBLEM_TYPE)


async def answer_ultragray_error(request: Request, error: Exception) -> Response:
    """Exception handler of UltragrayError."""
    assert isinstance(error, UltragrayError)
    return problem_response(error)


async def answer_http_exception(request: Request, error: Exception) -> Response:
    """Exception handler of what the framework raises: unknown routes and methods."""
    assert isinstance(error, HTTPException)
    if error.status_code == 405:
        detail = f"{request.url.path} does not answer {request.method}"
        return problem_response(MethodNotAllowed(detail), error.headers)
    if error.status_code == 404:
        return problem_response(RouteNotFound(f"there is no route {request.url.path}"))
    return problem_response(InvalidArgument(str(error.detail)))


async def answer_validation_error(request: Request, error: Exception) -> Response:
    """Exception handler of parameters that the framework checks."""
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    return problem_response(invalid_argument({**first, "loc": first["loc"][1:]}))  # without "query" or "path"


def invalid_argument(first: Mapping[str, Any]) -> InvalidArgument:
    """A pydantic error as one sentence that names the field, what was expected and what came."""
    path = _path(first["loc"])
    kind = str(first["type"])
    root = str(first["loc"][0]) if first["loc"] else ""
    if kind == "json_invalid":
        return InvalidArgument(f"this must be JSON: {first.get('ctx', {}).get('error', 'it cannot be read')}")
    if kind == "missing":
        detail = f"{path} is required"
    elif kind == "extra_forbidden":
        return InvalidArgument(f"{path} is not a known key", field=path)
    elif kind in ("union_tag_not_found", "union_tag_invalid"):
        path = f"{path}.kind"
        detail = f"{path} must be one of {', '.join(_PROBE_KINDS)}"
    else:
        message = str(first["msg"])
        _, verb, expected = message.partition(" should ")
        detail = f"{path or 'the body'} must {expected}" if verb else f"{path}: {message}"
        detail += f", got {_shown(first.get('input'))}"
    return _CLASS_OF_FIELD.get(root, InvalidArgument)(detail, field=path or None)


def _path(location: Iterable[int | str]) -> str:
    path = ""
    parts = list(location)
    for index, part in enumerate(parts):
        if isinstance(part, int):
            path += f"[{part}]"
        elif not (part in _PROBE_KINDS and index == 1 and parts[0] == "probe"):
            path += f".{part}" if path else part
    return path


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _SHOWN_INPUT else text[:_SHOWN_INPUT] + "…"
