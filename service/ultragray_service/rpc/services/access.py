"""AccessService."""

from __future__ import annotations

import grpc

from ultragray_proto.codec import to_message
from ultragray_proto.v1 import access_pb2

from ...access.principal import me
from ...core.state import Service


class AccessService:
    """The methods of ultragray.v1.AccessService."""

    def __init__(self, service: Service) -> None:
        self._service = service

    async def WhoAmI(  # noqa: N802
        self, request: access_pb2.WhoAmIRequest, context: grpc.aio.ServicerContext
    ) -> access_pb2.WhoAmIResponse:
        return to_message(me(self._service.guard.asks), access_pb2.WhoAmIResponse)
