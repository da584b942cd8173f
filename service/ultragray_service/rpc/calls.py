"""The surroundings of every call: API key, request id, trace, errors as google.rpc.Status, log line and metrics."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import defaultdict
from collections.abc import Awaitable, Callable
from typing import Any, NoReturn
from urllib.parse import unquote

import grpc
from google.protobuf.any_pb2 import Any as AnyMessage
from google.protobuf.duration_pb2 import Duration
from google.protobuf.message import DecodeError
from google.rpc.error_details_pb2 import BadRequest, ErrorInfo, RetryInfo
from google.rpc.status_pb2 import Status

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray_service.access.audit import NOBODY, Entry
from ultragray_service.access.credentials import offered_credential
from ultragray_service.access.principals import Principal
from ultragray_service.access.rules import GRPC_OPERATIONS, REFLECTION, Operation
from ultragray_service.errors import retry_after_s, statuses_of
from ultragray_service.service import Service
from ultragray_service.telemetry.logs import Tracing, choose_request_id, request_id


def address_of(peer: str) -> str:
    """The address of a peer as gRPC writes it: `ipv4:127.0.0.1:50000`, or `ipv6:%5B::1%5D:50000`."""
    return unquote(peer.partition(":")[2].rpartition(":")[0]).strip("[]")


ERROR_DOMAIN = "ultragray"
REQUEST_ID_KEY = "x-request-id"
_DETAILS_KEY = "grpc-status-details-bin"


def status_of(error: UltragrayError) -> Status:
    """The status, with ErrorInfo (domain, reason, metadata `field`), BadRequest and RetryInfo where apt."""
    statuses = statuses_of(error)
    code = getattr(grpc.StatusCode, statuses.grpc)
    info = ErrorInfo(reason=error.reason, domain=ERROR_DOMAIN, metadata={"field": error.field} if error.field else {})
    details = [info]
    if error.field and isinstance(error, InvalidArgument):
        violation = BadRequest.FieldViolation(field=error.field, description=error.detail)
        details.append(BadRequest(field_violations=[violation]))
    if (delay_s := retry_after_s(error)) is not None:
        details.append(RetryInfo(retry_delay=Duration(nanos=int(delay_s % 1 * 1e9), seconds=int(delay_s))))
    status = Status(code=code.value[0], message=error.detail)
    for detail in details:
        packed = AnyMessage()
        packed.Pack(detail)
        status.details.append(packed)
    return status


async def abort(context: grpc.aio.ServicerContext, error: UltragrayError) -> NoReturn:
    """Ends the call with `error`. Raises CancelledError where the caller is gone, which grpc tells a moment later."""
    details = ((_DETAILS_KEY, status_of(error).SerializeToString()), (REQUEST_ID_KEY, request_id.get()))
    try:
        await context.abort(getattr(grpc.StatusCode, statuses_of(error).grpc), error.detail, details)
    except grpc.aio.InternalError:
        raise asyncio.CancelledError from None
    raise AssertionError("abort always raises")


Method = Callable[[Any, Any], Awaitable[Any]]


def method_of(handler: Any) -> Method:
    for method in (handler.unary_unary, handler.unary_stream, handler.stream_unary, handler.stream_stream):
        if method is not None:
            return method  # type: ignore[no-any-return]
    raise AssertionError("a handler has one method")


def with_method(handler: Any, method: Method) -> Any:
    return _with(handler, method, handler.request_deserializer)


def refusing_what_is_no_message(handler: Any) -> Any:
    """The same handler, whose method decodes: what is no message is an InvalidArgument in it.

    gRPC itself would answer UNKNOWN with the name of a Python class, and log a traceback.
    """
    method, read = method_of(handler), handler.request_deserializer

    def decode(data: bytes) -> Any:
        try:
            return read(data)
        except DecodeError:
            raise InvalidArgument("the bytes are not a message of the type that the method takes") from None

    if handler.request_streaming:
        return _with(handler, method, decode)  # called by the method, whenever it reads

    async def call(data: bytes, context: Any) -> Any:
        return await method(decode(data), context)

    return _with(handler, call, None)


def _with(handler: Any, method: Method, deserializer: Callable[[bytes], Any] | None) -> Any:
    streaming = handler.request_streaming, handler.response_streaming
    return make_handler(streaming, method, deserializer, handler.response_serializer)


def make_handler(streaming: tuple[bool, bool], method: Method, *codecs: Any) -> grpc.RpcMethodHandler:
    """A handler of gRPC; `streaming`: whether requests and answers are several, `codecs`: what reads and writes one."""
    make = {
        (False, False): grpc.unary_unary_rpc_method_handler,
        (False, True): grpc.unary_stream_rpc_method_handler,
        (True, False): grpc.stream_unary_rpc_method_handler,
        (True, True): grpc.stream_stream_rpc_method_handler,
    }[streaming]
    return make(method, *codecs)


_GONE_S = 0.5  # after which grpc has told that a caller is gone
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
            method = method_of(handler) if is_own else _writing(method_of(handler))
            if self._service.tracing is not None:
                method = _traced(self._service.tracing, details.method.removeprefix("/"), headers, method)
            method = self._permitted(principal, credential, operation, method)
        handler = refusing_what_is_no_message(with_method(handler, method))
        return with_method(handler, self._wrap(details.method, method_of(handler), headers))

    def _permitted(self, principal: Principal, credential: str | None, operation: Operation, method: Method) -> Method:
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
            except grpc.aio.InternalError:  # a write: the caller is gone, as a rule, which ends this wait
                await asyncio.sleep(_GONE_S)
                await abort(context, UltragrayError("an answer could not be sent"))
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


def _traced(tracing: Tracing, name: str, headers: dict[str, str], method: Method) -> Method:
    async def call(request: Any, context: grpc.aio.ServicerContext) -> Any:
        with tracing.call(name, headers):
            return await method(request, context)

    return call


def _writing(method: Callable[[Any, Any], Any]) -> Method:
    """The reflection of the gRPC library, which yields its answers, as a method that can be ended with its key."""

    async def call(requests: Any, context: grpc.aio.ServicerContext) -> None:
        async for answer in method(requests, context):
            await context.write(answer)

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
