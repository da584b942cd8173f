"""The API's own pages. Their script and style come with the service: robots and hospitals are often offline."""

from __future__ import annotations

from fastapi import FastAPI
from fastapi.openapi.docs import get_swagger_ui_html
from starlette.responses import HTMLResponse
from starlette.staticfiles import StaticFiles

DOCS_PATH = "/docs"
# No page of another site shows this one within itself, where its visitors would click on what they do not see.
NOT_FRAMED = {"Content-Security-Policy": "frame-ancestors 'none'", "X-Frame-Options": "DENY"}
_STATIC_PATH = f"{DOCS_PATH}/static"


def add_docs(app: FastAPI) -> None:
    """Serves the pages under /docs."""
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
