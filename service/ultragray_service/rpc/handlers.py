"""Handlers of gRPC, taken apart and put together again by interceptors."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import grpc
from google.protobuf.message import DecodeError

from ultragray.errors import InvalidArgument

Method = Callable[[Any, Any], Awaitable[Any]]


def method_of(handler: Any) -> Method:
    """The method of a handler, which has one."""
    for method in (handler.unary_unary, handler.unary_stream, handler.stream_unary, handler.stream_stream):
        if method is not None:
            return method  # type: ignore[no-any-return]
    raise AssertionError("a handler has one method")


def with_method(handler: Any, method: Method) -> Any:
    """The same handler, its method replaced."""
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
    make = {
        (False, False): grpc.unary_unary_rpc_method_handler,
        (False, True): grpc.unary_stream_rpc_method_handler,
        (True, False): grpc.stream_unary_rpc_method_handler,
        (True, True): grpc.stream_stream_rpc_method_handler,
    }[handler.request_streaming, handler.response_streaming]
    return make(method, deserializer, handler.response_serializer)
