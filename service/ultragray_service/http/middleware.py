"""Pure ASGI middleware: request id, log line and metrics; API keys; body limit."""

from __future__ import annotations

import logging
import time

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ultragray.errors import UltragrayError

from ..auth import KeyGuard, key_of_subprotocols
from ..errors import BodyTooLarge, Unauthenticated
from ..telemetry.logs import choose_request_id, request_id
from ..telemetry.metrics import Metrics
from .console import ASSETS_PATH, CONSOLE_PATHS
from .problems import problem_response

REQUEST_ID_HEADER = "X-Request-Id"
_OPEN_PATHS = ("/v1/health/", "/docs", "/openapi.json", f"{ASSETS_PATH}/")
_QUIET_PATHS = ("/v1/health/", "/metrics")
_UPLOAD_PATHS = ("/v1/datasets/", "/v1/scenes/")
_CLIENT_GONE = 499

_log = logging.getLogger("ultragray.http")


class RequestContext:
    """Outermost: gives each request its id, logs and counts the answer, and answers what nobody caught."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            token = request_id.set(choose_request_id(Headers(scope=scope).get(REQUEST_ID_HEADER)))
            try:
                await self._app(scope, receive, send)
            finally:
                request_id.reset(token)
            return
        started = time.perf_counter()
        current = choose_request_id(Headers(scope=scope).get(REQUEST_ID_HEADER))
        token = request_id.set(current)
        status = 0

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                MutableHeaders(scope=message)[REQUEST_ID_HEADER] = current
            await send(message)

        try:
            await self._app(scope, receive, send_with_id)
        except ClientDisconnect:
            status = _CLIENT_GONE
        except Exception:
            _log.exception("unexpected error", extra={"fields": {"path": scope["path"]}})
            if status:
                raise
            await problem_response(UltragrayError("an unexpected error, see the log"))(scope, receive, send_with_id)
        finally:
            seconds = time.perf_counter() - started
            route = getattr(scope.get("route"), "path", "unmatched")
            self._metrics.count_request("http", route, str(status), seconds)
            level = logging.DEBUG if scope["path"].startswith(_QUIET_PATHS) else logging.INFO
            if _log.isEnabledFor(level):
                fields = {
                    "method": scope["method"],
                    "path": scope["path"],
                    "status": status,
                    "duration_ms": round(1000 * seconds, 3),
                }
                _log.log(level, "request", extra={"fields": fields})
            request_id.reset(token)


class RequireKey:
    """Lets through who has an API key, and everyone to health, the documentation and the files of the console."""

    def __init__(self, app: ASGIApp, guard: KeyGuard) -> None:
        self._app = app
        self._guard = guard

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["path"] not in CONSOLE_PATHS and not scope["path"].startswith(_OPEN_PATHS):
            headers = Headers(scope=scope)
            key = headers.get("x-api-key") or key_of_subprotocols(scope.get("subprotocols", ()))
            try:
                self._guard.check(headers.get("authorization"), key)
            except Unauthenticated as error:
                await problem_response(error)(scope, receive, send)
                return
        await self._app(scope, receive, send)


class LimitBody:
    """Refuses bodies over the limit, whether they announce their length or come in chunks.

    Uploads go straight to a disk and count for themselves.
    """

    def __init__(self, app: ASGIApp, limit_bytes: int) -> None:
        self._app = app
        self._limit_bytes = limit_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or (scope["method"] == "PUT" and scope["path"].startswith(_UPLOAD_PATHS)):
            await self._app(scope, receive, send)
            return
        announced = Headers(scope=scope).get("content-length", "")
        if announced.isdigit() and int(announced) > self._limit_bytes:
            await problem_response(self._too_large())(scope, receive, send)
            return
        received = 0

        async def receive_counted() -> Message:
            nonlocal received
            message = await receive()
            if message["type"] == "http.request":
                received += len(message.get("body", b""))
                if received > self._limit_bytes:
                    raise self._too_large()
            return message

        await self._app(scope, receive_counted, send)

    def _too_large(self) -> BodyTooLarge:
        return BodyTooLarge(f"the body must be at most {self._limit_bytes} bytes", field="body")
