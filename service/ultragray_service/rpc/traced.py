"""An interceptor for a service that is traced: a span for each call."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import grpc

from ultragray_service.rpc.handlers import method_of, with_method
from ultragray_service.rpc.interceptor import OWN_PREFIX
from ultragray_service.telemetry.logs import Tracing


class TracedCalls(grpc.aio.ServerInterceptor):  # type: ignore[misc]
    """Stands within `CallContext`, whose request id its spans carry."""

    def __init__(self, tracing: Tracing) -> None:
        self._tracing = tracing

    async def intercept_service(self, continuation: Callable[[Any], Awaitable[Any]], details: Any) -> Any:
        handler = await continuation(details)
        if handler is None or not details.method.startswith(OWN_PREFIX):
            return handler
        method = method_of(handler)
        headers = {key: value for key, value in details.invocation_metadata or () if isinstance(value, str)}

        async def call(request: Any, context: grpc.aio.ServicerContext) -> Any:
            with self._tracing.call(details.method.removeprefix("/"), headers):
                return await method(request, context)

        return with_method(handler, call)
