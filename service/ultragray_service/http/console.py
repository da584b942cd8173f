"""The console: the page that a browser gets at /, from the files that `make console` built."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Mapping
from pathlib import Path

from fastapi import FastAPI
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from ultragray_service.errors import RouteNotFound
from ultragray_service.http.docs import NOT_FRAMED
from ultragray_service.http.revalidation import revalidated
from ultragray_workers.storage.local import FileVersion

CONSOLE_FOLDER = Path(__file__).resolve().parents[1] / "console"
ASSETS_PATH = "/assets"
_PAGE_NAME = "index.html"
_BESIDE = {"favicon.svg": "image/svg+xml", "licences.txt": "text/plain"}  # the page: file name and media type
CONSOLE_PATHS = ("/", *(f"/{name}" for name in _BESIDE))  # and below ASSETS_PATH: a page cannot send a key for itself
_HOST = re.compile(r"[A-Za-z0-9._:\[\]-]+")
_POLICY = (
    "default-src 'self'",
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
    app: FastAPI, folder: Path = CONSOLE_FOLDER, *, token_origin: Callable[[], str | None] = lambda: None
) -> None:
    """Serves the console in `folder`, which may be built while the service runs; without it, a page that says how.

    `token_origin`: the one other site that the page may ask, for the tokens of those who sign in there.
    """
    app.mount(ASSETS_PATH, GZipMiddleware(_Assets(directory=folder / "assets", check_dir=False), minimum_size=1024))

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
    """Raises FileNotFoundError."""

    async def whole() -> Response:
        return Response(await asyncio.to_thread(path.read_bytes), media_type=media_type)

    response = await revalidated(request, FileVersion.of(path).tag, whole)
    response.headers.update(_headers(request, token_origin))
    return response


def _headers(request: Request, token_origin: str | None) -> Mapping[str, str]:
    """'self' is no WebSocket to some browsers, so that those of this host are named."""
    host = request.headers.get("host", "")
    sockets = f" ws://{host} wss://{host}" if _HOST.fullmatch(host) else ""
    tokens = "" if token_origin is None else f" {token_origin}"
    policy = "; ".join((*_POLICY, f"connect-src 'self'{sockets}{tokens}"))
    return {**NOT_FRAMED, **_PAGE_HEADERS, "Content-Security-Policy": policy}


class _Assets(StaticFiles):
    """Files whose names change with their content."""

    async def check_config(self) -> None:
        """No folder yet is no mistake: each file is not found."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        response.headers.update(_ASSET_HEADERS)
        return response
