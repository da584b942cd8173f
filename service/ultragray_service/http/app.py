"""The FastAPI application."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from pydantic import TypeAdapter
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware

from ultragray import __version__
from ultragray.errors import UltragrayError
from ultragray.probe import Probe

from ..core.state import Service
from . import problems
from .console import add_console
from .docs import add_docs
from .middleware import LimitBody, RequestContext, RequireKey
from .reading.bodies import SPECIFICATIONS, JobBody, RenderBody, StreamMessage
from .reading.json_body import adapter_of
from .routes import (
    comparison,
    datasets,
    health,
    jobs,
    metrics,
    probes,
    render,
    scene_files,
    scenes,
    statistics,
    stream,
    training,
)
from .stream_messages import FrameMessage, RefusalMessage

_DESCRIPTION = """B-mode frames from trained 3D-Gaussian ultrasound scenes.

Lengths are millimetres, angles degrees, quaternions w, x, y, z. Poses are rigid probe-to-scene transforms in
the frame of the sweep that the scene was trained from. Errors are `application/problem+json` with a stable
`reason`.
"""

_SECURITY_SCHEMES = {
    "Bearer": {"type": "http", "scheme": "bearer"},
    "ApiKey": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
}


_READ: tuple[Any, ...] = (RenderBody, StreamMessage, JobBody, *SPECIFICATIONS, Probe)
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
    )
    app.state.service = service
    # render comes first: its route is the one that must be found fast
    for module in (
        render,
        stream,
        scenes,
        scene_files,
        probes,
        datasets,
        comparison,
        jobs,
        training,
        statistics,
        health,
        metrics,
    ):
        app.include_router(module.router)
    add_docs(app)
    add_console(app)
    app.add_exception_handler(UltragrayError, problems.answer_ultragray_error)
    app.add_exception_handler(HTTPException, problems.answer_http_exception)
    app.add_exception_handler(RequestValidationError, problems.answer_validation_error)
    app.add_middleware(LimitBody, limit_bytes=service.settings.max_body_bytes)
    app.add_middleware(RequireKey, guard=service.guard)
    if service.settings.cors_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=list(service.settings.cors_origins),
            allow_methods=["GET", "POST", "PUT", "DELETE"],
            allow_headers=["*"],
            expose_headers=["Retry-After", *render.RENDER_HEADERS],
        )
    app.add_middleware(RequestContext, metrics=service.metrics)
    return app


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
            for unused in ("HTTPValidationError", "ValidationError"):
                schemas.pop(unused, None)
            if self.state.service.settings.api_keys:
                document["components"]["securitySchemes"] = _SECURITY_SCHEMES
                document["security"] = [{name: []} for name in _SECURITY_SCHEMES]
            self.openapi_schema = document
        return self.openapi_schema
