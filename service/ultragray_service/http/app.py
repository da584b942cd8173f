"""The FastAPI application: routes, documentation, the console, and what stands around every request."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from fastapi.openapi.docs import get_swagger_ui_html
from fastapi.telemetry import TelemetryConfig
from pydantic import TypeAdapter
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from ultragray import __version__
from ultragray.contract import to_dict
from ultragray.errors import UltragrayError
from ultragray.exchange.page import ASSETS as PACKAGE_FOLDER
from ultragray.geometry.probe import Probe
from ultragray.learn.training.config import PRESETS, TrainingConfig
from ultragray.rendering.volumes import SliceSettings
from ultragray_service.access.rules import WEBSOCKET, HttpRules
from ultragray_service.core.recordings import RecordingAnswer
from ultragray_service.errors import RouteNotFound
from ultragray_service.http import problems
from ultragray_service.http.bodies import (
    SPECIFICATIONS,
    AssessBody,
    EditBody,
    FrameHead,
    JobBody,
    LabelBody,
    LabelMapBody,
    LocalizeBody,
    PlanBody,
    RecipeBody,
    RegistrationBody,
    RenderBody,
    StreamMessage,
    adapter_of,
)
from ultragray_service.http.dependencies import revalidated
from ultragray_service.http.middleware import QUIET_PATHS, Authorize, CheckOrigin, LimitBody, RequestContext
from ultragray_service.http.routes import datasets, geometry, health, jobs, recordings, rendering, scenes, streams
from ultragray_service.http.routes.streams import FrameMessage, RefusalMessage
from ultragray_service.service import Service
from ultragray_service.telemetry.logs import Tracing
from ultragray_workers.datasets.recording import RecordingSettings
from ultragray_workers.storage.local import FileVersion

DOCS_PATH = "/docs"
# No page of another site shows this one within itself, where its visitors would click on what they do not see.
NOT_FRAMED = {"Content-Security-Policy": "frame-ancestors 'none'", "X-Frame-Options": "DENY"}
_STATIC_PATH = f"{DOCS_PATH}/static"


def add_docs(app: FastAPI) -> None:
    app.mount(_STATIC_PATH, StaticFiles(packages=[("fastapi_offline", "static")]))
    page = get_swagger_ui_html(
        openapi_url=str(app.openapi_url),
        title=app.title,
        swagger_js_url=f"{_STATIC_PATH}/swagger-ui-bundle.js",
        swagger_css_url=f"{_STATIC_PATH}/swagger-ui.css",
        swagger_favicon_url=f"{_STATIC_PATH}/favicon.png",
    )

    page.headers.update(NOT_FRAMED)

    @app.get(DOCS_PATH, include_in_schema=False)
    async def docs() -> HTMLResponse:
        return page


CONSOLE_FOLDER = Path(__file__).resolve().parents[1] / "console"
ASSETS_PATH = "/assets"
PACKAGE_PATH = "/package"  # of @ultragray/web, by which a page renders frames itself
_PAGE_NAME = "index.html"
_EXPOSED = ("Retry-After", "ETag", "Content-Range")  # to pages of other origins
_BESIDE = {"favicon.svg": "image/svg+xml", "licences.txt": "text/plain"}  # the page: file name and media type
_HOST = re.compile(r"[A-Za-z0-9._:\[\]-]+")
_POLICY = (
    "default-src 'self'",
    "script-src 'self' 'wasm-unsafe-eval'",  # the renderer is compiled once, for all workers of the page
    "img-src 'self' blob:",  # frames, and files that are saved
    "object-src 'none'",
    "base-uri 'none'",
    "form-action 'none'",
    NOT_FRAMED["Content-Security-Policy"],
)
_PAGE_HEADERS = {
    "Cross-Origin-Opener-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-cache",
}
_ASSET_HEADERS = {"X-Content-Type-Options": "nosniff", "Cache-Control": "public, max-age=31536000, immutable"}
# A worker has the policy of its own file.
_PACKAGE_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; connect-src 'self'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-cache",
}
_NOT_BUILT = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>UltraG-Ray</title>
<h1>UltraG-Ray</h1>
<p>The service runs. Its console was not built: with Node 20 or newer, run <code>make console</code> in the sources,
then load this page again.</p>
<p>Everything can be done without it, too: <a href="/docs">try the routes</a>, or use the command line and the Python
client.</p>
</html>
"""


def add_console(
    app: FastAPI,
    folder: Path = CONSOLE_FOLDER,
    package: Path = PACKAGE_FOLDER,
    *,
    token_origin: Callable[[], str | None] = lambda: None,
) -> None:
    """Serves the console in `folder`, which may be built while the service runs; without it, a page that says how.

    `package`: the modules of @ultragray/web, which may be missing. `token_origin`: the one other site that the page may
    ask, for the tokens of those who sign in there.
    """
    app.mount(ASSETS_PATH, GZipMiddleware(_Files(folder / "assets", _ASSET_HEADERS), minimum_size=1024))
    app.mount(PACKAGE_PATH, GZipMiddleware(_Files(package, _PACKAGE_HEADERS), minimum_size=1024))

    @app.api_route("/", methods=["GET", "HEAD"], include_in_schema=False)
    async def console(request: Request) -> Response:
        try:
            return await _file(request, folder / _PAGE_NAME, "text/html", token_origin())
        except FileNotFoundError:
            return HTMLResponse(_NOT_BUILT, headers=_headers(request, token_origin()))

    async def beside(request: Request) -> Response:
        name = request.url.path[1:]
        try:
            return await _file(request, folder / name, _BESIDE[name], None)
        except FileNotFoundError:
            raise RouteNotFound(f"there is no route /{name}: the console was not built") from None

    for name in _BESIDE:
        app.add_api_route(f"/{name}", beside, methods=["GET", "HEAD"], include_in_schema=False)


async def _file(request: Request, path: Path, media_type: str, token_origin: str | None) -> Response:
    content = partial(asyncio.to_thread, path.read_bytes)
    response = await revalidated(request, FileVersion.of(path).tag, content, media_type)
    response.headers.update(_headers(request, token_origin))
    return response


def _headers(request: Request, token_origin: str | None) -> Mapping[str, str]:
    """'self' is no WebSocket to some browsers, so that those of this host are named."""
    host = request.headers.get("host", "")
    sockets = f" ws://{host} wss://{host}" if _HOST.fullmatch(host) else ""
    tokens = "" if token_origin is None else f" {token_origin}"
    policy = "; ".join((*_POLICY, f"connect-src 'self'{sockets}{tokens}"))
    return {**NOT_FRAMED, **_PAGE_HEADERS, "Content-Security-Policy": policy}


class _Files(StaticFiles):
    """The files of a folder, all with the same headers."""

    def __init__(self, folder: Path, headers: Mapping[str, str]) -> None:
        super().__init__(directory=folder, check_dir=False)
        self._headers = headers

    async def check_config(self) -> None:
        """No folder yet is no mistake: each file is not found."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        response.headers.update(self._headers)
        return response


_DESCRIPTION = """B-mode frames from trained 3D-Gaussian ultrasound scenes.

Lengths are millimetres, angles degrees, quaternions w, x, y, z. Poses are rigid probe-to-scene transforms in
the frame of the sweep that the scene was trained from. Errors are `application/problem+json` with a stable
`reason`.
"""

# What the OpenAPI document says of each operation beside what is standard.
ROLE = "x-role"  # that it needs
OWNED = "x-owned"  # whether what it names must be the caller's own, but for admins
PRESETS_SET = "x-presets"  # the training settings that each preset sets otherwise
NAMED = "x-named"  # the members of a family that have names

_SECURITY_SCHEMES = {
    "Bearer": {"type": "http", "scheme": "bearer"},
    "ApiKey": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
}


# render comes first: its route is the one that must be found fast
_ROUTERS = (
    rendering.router,
    streams.router,
    scenes.router,
    geometry.router,
    geometry.registrations_router,
    datasets.router,
    datasets.comparison_router,
    recordings.router,
    jobs.router,
    jobs.workers_router,
    streams.streams_router,
    health.statistics_router,
    health.service_router,
    health.router,
    health.access_router,
)

_READ: tuple[Any, ...] = (
    RenderBody,
    SliceSettings,
    AssessBody,
    LocalizeBody,
    PlanBody,
    LabelBody,
    EditBody,
    RecipeBody,
    LabelMapBody,
    RegistrationBody,
    FrameHead,
    RecordingSettings,
    StreamMessage,
    JobBody,
    *SPECIFICATIONS,
    TrainingConfig,
    Probe,
)
_WRITTEN: tuple[Any, ...] = (problems.Problem, FrameMessage, RefusalMessage, RecordingAnswer)


def create_app(service: Service) -> FastAPI:
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
    routes = (*app.routes, *(route for router in _ROUTERS for route in router.routes))
    app.state.routes = [route for route in routes if isinstance(route, Route)]
    rules = HttpRules()
    rules.require_all(_method_paths(routes))
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
            expose_headers=[*_EXPOSED, *{**rendering.RENDER_HEADERS, **rendering.SLICE_HEADERS}],
        )
    app.add_middleware(CheckOrigin, guard=service.guard, origins=service.origins)
    app.add_middleware(RequestContext, metrics=service.metrics)
    return app


def _token_origin(service: Service) -> str | None:
    endpoints = None if service.tokens is None else service.tokens.issuer.endpoints
    if service.settings.oidc_client_id is None or endpoints is None:
        return None
    parts = urlsplit(endpoints.token)
    return f"{parts.scheme}://{parts.netloc}"


def _method_paths(routes: Iterable[BaseRoute]) -> Iterator[tuple[str, str]]:
    for route in routes:
        match route:
            case WebSocketRoute():
                yield WEBSOCKET, route.path
            case Mount():
                yield "GET", f"{route.path}/{{path:path}}"
            case Route():
                yield from ((method, route.path) for method in route.methods or ())


def _telemetry(tracing: Tracing | None) -> TelemetryConfig:
    config = TelemetryConfig(tracing=False, metrics=False, logs=False, operation_spans=False, auto_configure=False)
    if tracing is not None:
        config["tracing"] = True
        config["tracer_provider"] = tracing.provider
        config["exclude"] = lambda scope: scope["path"].startswith(QUIET_PATHS)
    return config


class _Application(FastAPI):
    def openapi(self) -> dict[str, Any]:
        if self.openapi_schema is None:
            document = super().openapi()
            definitions, extra = TypeAdapter.json_schemas(
                [(cls, "validation", adapter_of(cls)) for cls in _READ]
                + [(cls, "serialization", adapter_of(cls)) for cls in _WRITTEN],
                ref_template="#/components/schemas/{model}",
            )
            schemas = document.setdefault("components", {}).setdefault("schemas", {})
            schemas.update({cls.__name__: schema for (cls, _), schema in definitions.items() if "$ref" not in schema})
            schemas.update(extra["$defs"])
            schemas[TrainingConfig.__name__][PRESETS_SET] = PRESETS
            schemas[Probe.__name__][NAMED] = {name: to_dict(probe) for name, probe in Probe.named.items()}
            for method, path, operation in HttpRules().routes():
                entry = document["paths"].get(path, {}).get(method.lower())
                if entry is not None and operation.role is not None:
                    entry[ROLE] = operation.role.value
                    entry[OWNED] = operation.owned
            for unused in ("HTTPValidationError", "ValidationError"):
                schemas.pop(unused, None)
            if self.state.service.guard.asks:
                document["components"]["securitySchemes"] = _SECURITY_SCHEMES
                document["security"] = [{name: []} for name in _SECURITY_SCHEMES]
            self.openapi_schema = document
        return self.openapi_schema
