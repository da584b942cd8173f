"""The HTTP interface, as docs/interfaces.md lists it."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from ultragray import (
    LinearProbe,
)
from ultragray.confidence import Extrapolation
from ultragray.errors import error_classes
from ultragray.settings import Resolved
from ultragray_service import http
from ultragray_service.core.state import Service
from ultragray_service.http import middleware, problems
from ultragray_service.http.app import create_app
from ultragray_service.http.docs import DOCS_PATH
from ultragray_service.http.reading import accept
from ultragray_service.http.reading.bodies import RenderBody
from ultragray_service.http.reading.json_body import read_json
from ultragray_service.http.routes import render as render_route
from ultragray_workers.pool.types import RenderResult

from .document import DOCUMENT, headers_read, numbers, table


@pytest.fixture
def openapi(service: Service) -> dict[str, Any]:
    return create_app(service).openapi()


def test_routes(service: Service, openapi: dict[str, Any]) -> None:
    found = {
        f"{method.upper()} {path}": sorted(map(int, operation["responses"]))
        for path, operations in openapi["paths"].items()
        for method, operation in operations.items()
    }
    app = create_app(service)
    found |= {f"GET {path}": [200] for path in (DOCS_PATH, app.openapi_url)}
    assert {name: [int(n) for n in numbers(statuses)] for name, (statuses, _) in table("Routes").items()} == found


def test_query_parameters(openapi: dict[str, Any]) -> None:
    found = {
        parameter["name"]: parameter["schema"]["default"]
        for operations in openapi["paths"].values()
        for operation in operations.values()
        for parameter in operation.get("parameters", ())
        if parameter["in"] == "query"
    }
    documented = {name: cell for name, (cell, _) in table("Query parameters").items()}
    assert documented == {name: f"`{value}`" if value else "empty" for name, value in found.items()}


def test_accept_types() -> None:
    assert list(table("Accept")) == list(accept.MEDIA_TYPES)


def test_request_headers() -> None:
    assert {name.lower() for name in table("Request headers")} == headers_read(http)


@pytest.fixture
def rendered() -> RenderResult:
    return RenderResult(
        scene="demo",
        scene_sha256="0" * 64,
        renderer="ultragray",
        poses=np.eye(4)[None],
        settings=Resolved(LinearProbe(40, 0, 50), 1, 1),
        data=b"\0",
        queue_ms=0.0,
        render_ms=0.0,
        encode_ms=0.0,
        extrapolations=(Extrapolation(None, None, None, None),),
        batch_size=1,
    )


def test_render_headers(rendered: RenderResult) -> None:
    sent = {*render_route.render_headers(rendered), middleware.REQUEST_ID_HEADER}
    assert set(table("Render headers")) == sent == set(render_route.RENDER_HEADERS)


def test_error_headers() -> None:
    answers = [problems.problem_response(cls("no")) for cls in error_classes()]
    own = {name for answer in answers for name in answer.headers} - {"content-type", "content-length"}
    assert {name.lower() for name in table("Error headers")} == own | {"allow"}  # Allow is the framework's


def test_example_bodies() -> None:
    examples = re.findall(r"-d '(\{.*?\})'", DOCUMENT, flags=re.DOTALL)
    assert examples
    for example in examples:
        read_json(example, RenderBody)
