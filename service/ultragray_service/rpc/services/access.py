"""AccessService."""

from __future__ import annotations

import grpc

from ultragray_proto.codec import to_message
from ultragray_proto.v1 import access_pb2
from ultragray_service.access.principals import me
from ultragray_service.service import Service
from ultragray_service.views.audited import DEFAULT_ENTRIES, DEFAULT_HOURS, audit_entries


class AccessService:
    """The methods of ultragray.v1.AccessService."""

    def __init__(self, service: Service) -> None:
        self._service = service

    async def WhoAmI(  # noqa: N802
        self, request: access_pb2.WhoAmIRequest, context: grpc.aio.ServicerContext
    ) -> access_pb2.WhoAmIResponse:
        return to_message(me(self._service.guard.asks), access_pb2.WhoAmIResponse)

    async def ListAuditEntries(  # noqa: N802
        self, request: access_pb2.ListAuditEntriesRequest, context: grpc.aio.ServicerContext
    ) -> access_pb2.ListAuditEntriesResponse:
        entries = await audit_entries(
            self._service.jobs.database.engine,
            since_hours=request.since_hours or DEFAULT_HOURS,
            who=request.who or None,
            what=request.what or None,
            limit=request.limit or DEFAULT_ENTRIES,
        )
        return to_message(entries, access_pb2.ListAuditEntriesResponse)
