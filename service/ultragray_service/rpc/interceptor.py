"""The surroundings of every call: API keys, request id, errors as statuses, log line and metrics."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import defaultdict
from collections.abc import Awaitable, Callable
from typing import Any

import grpc

from ultragray.errors import UltragrayError
from ultragray_service.access.audit import NOBODY, Entry
from ultragray_service.access.credentials import offered_credential
from ultragray_service.access.principals import Principal
from ultragray_service.access.rules import GRPC_OPERATIONS, REFLECTION, Operation
from ultragray_service.errors import statuses_of
from ultragray_service.rpc.handlers import Method, method_of, refusing_what_is_no_message, with_method
from ultragray_service.rpc.peers import address_of
from ultragray_service.rpc.status import REQUEST_ID_KEY, abort
from ultragray_service.service import Service
from ultragray_service.telemetry.logs import choose_request_id, request_id

_OPEN_PREFIX = "/grpc.health.v1."
OWN_PREFIX = "/ultragray."

_log = logging.getLogger("ultragray.grpc")


class CallContext(grpc.aio.ServerInterceptor):  # type: ignore[misc]
    """Wraps each call of our own services; keeps all but health from callers without a key."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._guard = service.guard
        self._origins = service.origins
        self._metrics = service.metrics

    async def intercept_service(self, continuation: Callable[[Any], Awaitable[Any]], details: Any) -> Any:
        handler = await continuation(details)
        if handler is None:
            return None
        texts = [(key, value) for key, value in details.invocation_metadata or () if isinstance(value, str)]
        headers = dict(texts)
        all_headers = defaultdict[str, list[str]](list)
        for key, value in texts:
            all_headers[key].append(value)
        if details.method.startswith(_OPEN_PREFIX):
            handler = refusing_what_is_no_message(handler)
            return with_method(handler, _telling_errors(method_of(handler)))
        is_own = details.method.startswith(OWN_PREFIX)
        operation = GRPC_OPERATIONS[details.method] if is_own else REFLECTION
        try:
            if not self._guard.asks:
                # of a proxy that speaks gRPC for pages
                self._origins.require_page(origin=headers.get("origin"), host=None)
            credential = offered_credential(all_headers["authorization"], all_headers["x-api-key"])
            principal = self._guard.authenticate(credential)
        except UltragrayError as error:
            method = self._refusing(operation, error)
        else:
            if not is_own:
                return handler
            method = self._permitted(principal, credential, operation, method_of(handler))
        handler = with_method(handler, method)
        if is_own:
            handler = refusing_what_is_no_message(handler)
        return with_method(handler, self._wrap(details.method, method_of(handler), headers))

    def _permitted(self, principal: Principal, credential: str | None, operation: Operation, method: Method) -> Method:
        """The method, for who may; it ends when the credential counts no more."""
        service = self._service

        async def call(request: Any, context: Any) -> Any:
            peer, target = context.peer(), name_in(request, operation)
            async with service.admission.permitted(
                principal, credential, operation, target, address=address_of(peer), connection=peer
            ):
                return await method(request, context)

        return call

    def _refusing(self, operation: Operation, error: UltragrayError) -> Method:
        async def refuse(request: Any, context: Any) -> Any:
            entry = Entry(NOBODY, address_of(context.peer()), operation.name, name_in(request, operation), error.reason)
            self._service.audit.count(entry)
            raise error

        return refuse

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


def _telling_errors(method: Method) -> Method:
    async def call(request: Any, context: grpc.aio.ServicerContext) -> Any:
        try:
            return await method(request, context)
        except UltragrayError as error:
            await abort(context, error)

    return call


def name_in(request: Any, operation: Operation) -> str:
    """The name of what a request is about; empty where its first message has still to come."""
    if operation.about is None:
        return ""
    holder = getattr(request, "settings", request)
    return str(getattr(holder, operation.about.value, ""))
