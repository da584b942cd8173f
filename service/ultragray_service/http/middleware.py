"""Pure ASGI middleware: request id, log line and metrics; API keys; body limit."""

from __future__ import annotations

import logging
import time

from opentelemetry import trace
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ultragray.errors import UltragrayError
from ultragray_service.access.audit import NOBODY
from ultragray_service.access.credentials import Guard, credentials_of_subprotocols, offered_credential
from ultragray_service.access.origins import Origins
from ultragray_service.access.rules import UNKNOWN, WEBSOCKET, HttpRules, Operation
from ultragray_service.errors import BodyTooLarge, HostRefused, OriginRefused
from ultragray_service.http.problems import problem_response
from ultragray_service.service import Service
from ultragray_service.telemetry.logs import REQUEST_ID_ATTRIBUTE, choose_request_id, request_id
from ultragray_service.telemetry.metrics import Metrics

REQUEST_ID_HEADER = "X-Request-Id"
QUIET_PATHS = ("/v1/health/", "/metrics")
_UPLOAD_PATHS = ("/v1/datasets/", "/v1/scenes/")
_CLIENT_GONE = 499
_POLICY_VIOLATION = 1008  # of RFC 6455

_log = logging.getLogger("ultragray.http")


class RequestContext:
    """Outermost: gives each request its id, logs and counts the answer, and answers what nobody caught."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app, self._metrics = app, metrics

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
        trace.get_current_span().set_attribute(REQUEST_ID_ATTRIBUTE, current)
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
            level = logging.DEBUG if scope["path"].startswith(QUIET_PATHS) else logging.INFO
            if _log.isEnabledFor(level):
                fields = {
                    "method": scope["method"],
                    "path": scope["path"],
                    "status": status,
                    "duration_ms": round(1000 * seconds, 3),
                }
                _log.log(level, "request", extra={"fields": fields})
            request_id.reset(token)


class CheckOrigin:
    """Keeps pages of other sites away: from everything where no key is asked for, else from WebSockets."""

    def __init__(self, app: ASGIApp, guard: Guard, origins: Origins) -> None:
        self._app, self._guard, self._origins = app, guard, origins

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            headers = Headers(scope=scope)
            if not self._guard.asks:
                for host in headers.getlist("host"):
                    self._origins.require_host(host)
            if scope["type"] == "websocket" or not self._guard.asks:
                self._origins.require_page(
                    origin=headers.get("origin"),
                    host=headers.get("host"),
                    fetch_site=headers.get("sec-fetch-site"),
                    is_link=scope.get("method") in ("GET", "HEAD")
                    and headers.get("sec-fetch-mode") == "navigate"
                    and headers.get("sec-fetch-dest") == "document",
                )
        except (HostRefused, OriginRefused) as error:
            await problem_response(error)(scope, receive, send)
        else:
            await self._app(scope, receive, send)


class Authorize:
    """Finds out who asks and whether they may, keeps account of it, and ends it when the key counts no more."""

    def __init__(self, app: ASGIApp, service: Service, rules: HttpRules) -> None:
        self._app, self._service, self._rules = app, service, rules

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        method = WEBSOCKET if scope["type"] == "websocket" else scope["method"]
        operation, target = self._rules.find(method, scope["path"]) or (UNKNOWN, "")
        if operation.role is None and operation is not UNKNOWN:
            await self._app(scope, receive, send)
            return
        started = False

        async def send_noted(message: Message) -> None:
            nonlocal started
            started = True
            await send(message)

        try:
            await self._permitted(operation, target, scope, receive, send_noted)
        except UltragrayError as error:
            if not started:
                await problem_response(error)(scope, receive, send)
            elif scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": _POLICY_VIOLATION, "reason": error.reason})

    async def _permitted(self, operation: Operation, target: str, scope: Scope, receive: Receive, send: Send) -> None:
        service, headers = self._service, Headers(scope=scope)
        address, port = scope.get("client") or ("", 0)
        keys = [*headers.getlist("x-api-key"), *credentials_of_subprotocols(scope.get("subprotocols", ()))]
        with service.audit.refusals(NOBODY, address, operation, target):
            credential = offered_credential(headers.getlist("authorization"), keys)
            principal = service.guard.authenticate(credential)
        connection = f"{address}:{port}"
        async with service.admission.permitted(
            principal, credential, operation, target, address=address, connection=connection
        ):
            await self._app(scope, receive, send)


class LimitBody:
    """Refuses bodies over the limit, announced or not; uploads go straight to a disk and count for themselves."""

    def __init__(self, app: ASGIApp, limit_bytes: int) -> None:
        self._app, self._limit_bytes = app, limit_bytes

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
