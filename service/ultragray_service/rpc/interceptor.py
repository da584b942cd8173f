"""The surroundings of every call: API keys, request id, errors as statuses, log line and metrics."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable
from typing import Any

import grpc

from ultragray.errors import UltragrayError

from ..auth import KeyGuard
from ..errors import Unauthenticated, statuses_of
from ..telemetry.logs import choose_request_id, request_id
from ..telemetry.metrics import Metrics
from .status import REQUEST_ID_KEY, abort

_OPEN_PREFIX = "/grpc.health.v1."
_OWN_PREFIX = "/ultragray."

_log = logging.getLogger("ultragray.grpc")

Method = Callable[[Any, Any], Awaitable[Any]]


class CallContext(grpc.aio.ServerInterceptor):  # type: ignore[misc]
    """Wraps each call of our own services; keeps all but health from callers without a key."""

    def __init__(self, guard: KeyGuard, metrics: Metrics) -> None:
        self._guard = guard
        self._metrics = metrics

    async def intercept_service(self, continuation: Callable[[Any], Awaitable[Any]], details: Any) -> Any:
        handler = await continuation(details)
        if handler is None:
            return None
        headers = {key: value for key, value in details.invocation_metadata or () if isinstance(value, str)}
        if not details.method.startswith(_OPEN_PREFIX):
            try:
                self._guard.check(headers.get("authorization"), headers.get("x-api-key"))
            except Unauthenticated as error:
                return _with_method(handler, self._wrap(details.method, _refusing(error), headers))
        if not details.method.startswith(_OWN_PREFIX):
            return handler
        return _with_method(handler, self._wrap(details.method, _method_of(handler), headers))

    def _wrap(self, name: str, method: Method, headers: dict[str, str]) -> Method:
        async def call(request: Any, context: grpc.aio.ServicerContext) -> Any:
            started = time.perf_counter()
            current = choose_request_id(headers.get(REQUEST_ID_KEY))
            request_id.set(current)
            context.set_trailing_metadata(((REQUEST_ID_KEY, current),))
            status = grpc.StatusCode.CANCELLED.name
            try:
                answer = await method(request, context)
                status = grpc.StatusCode.OK.name
            except asyncio.CancelledError:
                raise
            except grpc.aio.InternalError:  # a write: the caller is gone, which grpc tells a moment later
                raise asyncio.CancelledError from None
            except UltragrayError as error:
                status = statuses_of(error).grpc
                await abort(context, error)
            except Exception:
                _log.exception("unexpected error", extra={"fields": {"method": name}})
                status = grpc.StatusCode.INTERNAL.name
                await abort(context, UltragrayError("an unexpected error, see the log"))
            finally:
                seconds = time.perf_counter() - started
                self._metrics.count_request("grpc", name, status, seconds)
                fields = {"method": name, "status": status, "duration_ms": round(1000 * seconds, 3)}
                _log.info("request", extra={"fields": fields})
            return answer

        return call


def _refusing(error: UltragrayError) -> Method:
    async def refuse(request: Any, context: Any) -> Any:
        raise error

    return refuse


def _method_of(handler: Any) -> Method:
    for method in (handler.unary_unary, handler.unary_stream, handler.stream_unary, handler.stream_stream):
        if method is not None:
            return method  # type: ignore[no-any-return]
    raise AssertionError("a handler has one method")


def _with_method(handler: Any, method: Method) -> Any:
    """The same handler, its method replaced."""
    wrap = {
        (False, False): grpc.unary_unary_rpc_method_handler,
        (False, True): grpc.unary_stream_rpc_method_handler,
        (True, False): grpc.stream_unary_rpc_method_handler,
        (True, True): grpc.stream_stream_rpc_method_handler,
    }[handler.request_streaming, handler.response_streaming]
    return wrap(method, handler.request_deserializer, handler.response_serializer)
