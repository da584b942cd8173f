"""Every error as RFC 9457 application/problem+json."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Match

from ultragray.contract import blamed, error_under, join, shown
from ultragray.errors import InvalidArgument, UltragrayError
from ultragray_service.access.audit import account
from ultragray_service.errors import MethodNotAllowed, RouteNotFound, retry_after_s, statuses_of
from ultragray_service.telemetry.logs import request_id

PROBLEM_TYPE = "application/problem+json"

_SHOWN_PATH = 200


class Problem(BaseModel):
    """An error (RFC 9457). `reason` is stable; `field` is the path of the value to blame, null if none is."""

    type: str = Field(examples=["urn:ultragray:problem:scene-not-found"])
    title: str = Field(examples=["No such scene"])
    status: int = Field(examples=[404])
    detail: str = Field(examples=["no scene named 'liver'"])
    reason: str = Field(examples=["SCENE_NOT_FOUND"])
    field: str | None = Field(examples=["scene"])
    request_id: str


def problem_response(
    error: UltragrayError, headers: Mapping[str, str] | None = None, members: Mapping[str, Any] | None = None
) -> Response:
    """The answer that tells a client about `error`; `members`: more of the document, beside those of Problem."""
    statuses = statuses_of(error)
    account().result = error.reason
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
    if (delay_s := retry_after_s(error)) is not None:
        all_headers["Retry-After"] = str(math.ceil(delay_s))
    if statuses.http == 401:
        all_headers["WWW-Authenticate"] = "Bearer"
    content = json.dumps({**document.model_dump(), **(members or {})}, ensure_ascii=False)
    return Response(content.encode("utf-8", "replace"), statuses.http, all_headers, PROBLEM_TYPE)


async def answer_ultragray_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, UltragrayError)
    return problem_response(error)


async def answer_http_exception(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    if error.status_code == 405:
        allowed = ", ".join(_methods_of_path(request))
        detail = f"{request.url.path[:_SHOWN_PATH]} answers {allowed}, not {request.method}"
        return problem_response(MethodNotAllowed(detail), {"Allow": allowed})
    if error.status_code == 404:
        return problem_response(RouteNotFound(f"there is no route {request.url.path[:_SHOWN_PATH]}"))
    return problem_response(InvalidArgument(str(error.detail)))


def _methods_of_path(request: Request) -> list[str]:
    """The methods of all routes of the path; the framework knows those of the first one."""
    methods: set[str] = set()
    for route in request.app.state.routes:
        match, _ = route.matches(request.scope)
        if match is not Match.NONE:
            methods |= route.methods
    return sorted(methods)


async def answer_validation_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    return problem_response(invalid_argument({**first, "loc": first["loc"][1:]}))  # without "query" or "path"


def invalid_argument(first: Mapping[str, Any], cls: Any = None) -> UltragrayError:
    """A pydantic error of a value of a class: one sentence that names the field, what was expected and what came."""
    path, error, kind_of_value = blamed(cls, first["loc"])
    match first["type"]:
        case "value_error" if isinstance(original := first["ctx"]["error"], UltragrayError):
            return error_under(path, original) if path else original
        case "json_invalid":
            return InvalidArgument(f"this must be JSON: {first['ctx']['error']}")
        case "missing":
            return error(f"{path} is required", field=path)
        case "extra_forbidden" | "unexpected_keyword_argument":
            return InvalidArgument(f"{path} is not a known key", field=path)
        case "union_tag_not_found" | "union_tag_invalid":
            kinds = ", ".join(kind_of_value.members)
            path = join(path, "kind")
            return error(f"{path} must be one of {kinds}, got {shown(first['input'].get('kind'))}", field=path)
    message = str(first["msg"])
    _, verb, expected = message.partition(" should ")
    detail = f"{path or 'the body'} must {expected}" if verb else f"{path}: {message}"
    return error(f"{detail}, got {shown(first.get('input'))}", field=path or None)
