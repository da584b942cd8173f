"""The FastAPI application."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any
from urllib.parse import urlsplit

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from fastapi.telemetry import TelemetryConfig
from pydantic import TypeAdapter
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute

from ultragray import __version__
from ultragray.errors import UltragrayError
from ultragray.learn.training.config import PRESETS, TrainingConfig
from ultragray.probe import Probe
from ultragray.volumes.plane import SliceSettings
from ultragray_service.access.rules import WEBSOCKET, HttpRules
from ultragray_service.core.state import Service
from ultragray_service.http import problems
from ultragray_service.http.console import add_console
from ultragray_service.http.docs import add_docs
from ultragray_service.http.middleware import QUIET_PATHS, Authorize, CheckOrigin, LimitBody, RequestContext
from ultragray_service.http.reading.bodies import (
    SPECIFICATIONS,
    AssessBody,
    JobBody,
    LocalizeBody,
    RegistrationBody,
    RenderBody,
    StreamMessage,
)
from ultragray_service.http.reading.json_body import adapter_of
from ultragray_service.http.routes import (
    access,
    comparison,
    datasets,
    health,
    scene_files,
    scenes,
    service_info,
    statistics,
    stream,
    streams,
)
from ultragray_service.http.routes.geometry import probes, registrations
from ultragray_service.http.routes.jobs import jobs, training, workers
from ultragray_service.http.routes.rendering import render, slices
from ultragray_service.http.stream_messages import FrameMessage, RefusalMessage
from ultragray_service.telemetry.tracing import Tracing

_DESCRIPTION = """B-mode frames from trained 3D-Gaussian ultrasound scenes.

Lengths are millimetres, angles degrees, quaternions w, x, y, z. Poses are rigid probe-to-scene transforms in
the frame of the sweep that the scene was trained from. Errors are `application/problem+json` with a stable
`reason`.
"""

# What the OpenAPI document says of each operation beside what is standard.
ROLE = "x-role"  # that it needs
OWNED = "x-owned"  # whether what it names must be the caller's own, but for admins
PRESETS_SET = "x-presets"  # the training settings that each preset sets otherwise

_SECURITY_SCHEMES = {
    "Bearer": {"type": "http", "scheme": "bearer"},
    "ApiKey": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
}


# render comes first: its route is the one that must be found fast
_ROUTERS = (
    render.router,
    slices.router,
    stream.router,
    scenes.router,
    scene_files.router,
    probes.router,
    registrations.router,
    datasets.router,
    comparison.router,
    jobs.router,
    training.router,
    workers.router,
    streams.router,
    statistics.router,
    service_info.router,
    health.router,
    access.router,
)

_READ: tuple[Any, ...] = (
    RenderBody,
    SliceSettings,
    AssessBody,
    LocalizeBody,
    RegistrationBody,
    StreamMessage,
    JobBody,
    *SPECIFICATIONS,
    TrainingConfig,
    Probe,
)
_WRITTEN: tuple[Any, ...] = (problems.Problem, FrameMessage, RefusalMessage)


def create_app(service: Service) -> FastAPI:
    """The application of one service."""
    app = _Application(
        title="UltraG-Ray",
        version=__version__,
        description=_DESCRIPTION,
        docs_url=None,  # see add_docs
        redoc_url=None,
        redirect_slashes=False,
        telemetry=_telemetry(service.tracing),
    )
    app.state.service = service
    for router in _ROUTERS:
        app.include_router(router)
    add_docs(app)
    add_console(app, token_origin=lambda: _token_origin(service))
    found = (*app.routes, *(route for router in _ROUTERS for route in router.routes))
    app.state.routes = [route for route in found if isinstance(route, Route)]
    rules = HttpRules()
    rules.require_all(_asked_for(found))
    app.add_exception_handler(UltragrayError, problems.answer_ultragray_error)
    app.add_exception_handler(HTTPException, problems.answer_http_exception)
    app.add_exception_handler(RequestValidationError, problems.answer_validation_error)
    app.add_middleware(LimitBody, limit_bytes=service.settings.max_body_bytes)
    app.add_middleware(Authorize, service=service, rules=rules)
    if service.settings.cors_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=list(service.settings.cors_origins),
            allow_methods=["GET", "POST", "PUT", "DELETE"],
            allow_headers=["*"],
            expose_headers=["Retry-After", *{**render.RENDER_HEADERS, **slices.SLICE_HEADERS}],
        )
    app.add_middleware(CheckOrigin, guard=service.guard, origins=service.origins)
    app.add_middleware(RequestContext, metrics=service.metrics)
    return app


def _token_origin(service: Service) -> str | None:
    """Where the console gets people's tokens; None: they sign in with keys alone."""
    endpoints = None if service.tokens is None else service.tokens.issuer.endpoints
    if service.settings.oidc_client_id is None or endpoints is None:
        return None
    parts = urlsplit(endpoints.token)
    return f"{parts.scheme}://{parts.netloc}"


def _asked_for(routes: Iterable[BaseRoute]) -> Iterator[tuple[str, str]]:
    """The method and path of every route."""
    for route in routes:
        match route:
            case WebSocketRoute():
                yield WEBSOCKET, route.path
            case Mount():
                yield "GET", f"{route.path}/{{path:path}}"
            case Route():
                yield from ((method, route.path) for method in route.methods or ())


def _telemetry(tracing: Tracing | None) -> TelemetryConfig:
    """A span for each request and stream of a service that is traced; Prometheus has the metrics."""
    config = TelemetryConfig(tracing=False, metrics=False, logs=False, operation_spans=False, auto_configure=False)
    if tracing is not None:
        config["tracing"] = True
        config["tracer_provider"] = tracing.provider
        config["exclude"] = lambda scope: scope["path"].startswith(QUIET_PATHS)
    return config


class _Application(FastAPI):
    """FastAPI, with the schemas of what the routes read and answer by themselves."""

    def openapi(self) -> dict[str, Any]:
        if self.openapi_schema is None:
            document = super().openapi()
            found, extra = TypeAdapter.json_schemas(
                [(cls, "validation", adapter_of(cls)) for cls in _READ]
                + [(cls, "serialization", adapter_of(cls)) for cls in _WRITTEN],
                ref_template="#/components/schemas/{model}",
            )
            schemas = document.setdefault("components", {}).setdefault("schemas", {})
            schemas.update({cls.__name__: schema for (cls, _), schema in found.items() if "$ref" not in schema})
            schemas.update(extra["$defs"])
            schemas[TrainingConfig.__name__][PRESETS_SET] = PRESETS
            for method, path, operation in HttpRules().routes():
                told = document["paths"].get(path, {}).get(method.lower())
                if told is not None and operation.role is not None:
                    told[ROLE] = operation.role.value
                    told[OWNED] = operation.owned
            for unused in ("HTTPValidationError", "ValidationError"):
                schemas.pop(unused, None)
            if self.state.service.guard.asks:
                document["components"]["securitySchemes"] = _SECURITY_SCHEMES
                document["security"] = [{name: []} for name in _SECURITY_SCHEMES]
            self.openapi_schema = document
        return self.openapi_schema
