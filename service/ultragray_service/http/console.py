"""The console: the page that a browser gets at /, from the files that `make console` built."""

from __future__ import annotations

from pathlib import Path

from fastapi import FastAPI
from starlette.middleware.gzip import GZipMiddleware
from starlette.responses import FileResponse, HTMLResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from ultragray.errors import RouteNotFound

CONSOLE_FOLDER = Path(__file__).resolve().parents[1] / "console"
ASSETS_PATH = "/assets"
CONSOLE_PATHS = ("/", "/favicon.svg")  # and what lies below ASSETS_PATH: a page cannot send a key for itself
_PAGE_NAME, _ICON_NAME = "index.html", "favicon.svg"
_POLICY = "; ".join(
    (
        "default-src 'self'",
        "img-src 'self' blob:",  # frames, and files that are saved
        "object-src 'none'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
_PAGE_HEADERS = {
    "Content-Security-Policy": _POLICY,
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


def add_console(app: FastAPI, folder: Path = CONSOLE_FOLDER) -> None:
    """Serves the console in `folder`, which may be built while the service runs; without it, a page that says how."""
    app.mount(ASSETS_PATH, GZipMiddleware(_Assets(directory=folder / "assets", check_dir=False), minimum_size=1024))

    @app.get("/", include_in_schema=False)
    async def console() -> Response:
        page = folder / _PAGE_NAME
        if page.is_file():
            return FileResponse(page, headers=_PAGE_HEADERS, media_type="text/html")
        return HTMLResponse(_NOT_BUILT, headers=_PAGE_HEADERS)

    @app.get(f"/{_ICON_NAME}", include_in_schema=False)
    async def icon() -> FileResponse:
        path = folder / _ICON_NAME
        if not path.is_file():
            raise RouteNotFound(f"there is no route /{_ICON_NAME}: the console was not built")
        return FileResponse(path, headers=_PAGE_HEADERS, media_type="image/svg+xml")


class _Assets(StaticFiles):
    """Files whose names change with their content."""

    async def check_config(self) -> None:
        """No folder yet is no mistake: each file is not found."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        response.headers.update(_ASSET_HEADERS)
        return response
