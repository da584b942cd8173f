"""RegistrationService."""

from __future__ import annotations

import grpc
import numpy as np

from ultragray.contract import under
from ultragray.errors import InvalidArgument, InvalidPose
from ultragray.registration.registration import Registration, rows
from ultragray_proto.codec import to_message
from ultragray_proto.v1 import geometry_pb2, registrations_pb2
from ultragray_service.core.scenes import DEFAULT_PAGE_SIZE
from ultragray_service.rpc.messages import read
from ultragray_service.service import Service

_LINKS = ("base_to_scene", "probe_to_flange")


class RegistrationService:
    """The methods of ultragray.v1.RegistrationService."""

    def __init__(self, service: Service) -> None:
        self._service = service

    async def ListRegistrations(  # noqa: N802
        self, request: registrations_pb2.ListRegistrationsRequest, context: grpc.aio.ServicerContext
    ) -> registrations_pb2.ListRegistrationsResponse:
        page_size = request.page_size or DEFAULT_PAGE_SIZE
        page = await self._service.registrations.page(page_size, request.page_token)
        return to_message(page, registrations_pb2.ListRegistrationsResponse)

    async def GetRegistration(  # noqa: N802
        self, request: registrations_pb2.GetRegistrationRequest, context: grpc.aio.ServicerContext
    ) -> registrations_pb2.Registration:
        return to_message(await self._service.registrations.get(request.registration), registrations_pb2.Registration)

    async def PutRegistration(  # noqa: N802
        self, request: registrations_pb2.PutRegistrationRequest, context: grpc.aio.ServicerContext
    ) -> registrations_pb2.Registration:
        content = request.content
        with under("content"):
            if not content.HasField("base_to_scene"):
                raise InvalidArgument("base_to_scene is required", field="base_to_scene")
            links = {name: _rows(getattr(content, name), name) for name in _LINKS if content.HasField(name)}
            registration: Registration = read(content, Registration, **links)
        kept = await self._service.registrations.put(request.registration, content.scene, registration)
        return to_message(kept, registrations_pb2.Registration)

    async def DeleteRegistration(  # noqa: N802
        self, request: registrations_pb2.DeleteRegistrationRequest, context: grpc.aio.ServicerContext
    ) -> registrations_pb2.DeleteRegistrationResponse:
        await self._service.registrations.delete(request.registration)
        return registrations_pb2.DeleteRegistrationResponse()


def _rows(matrix: geometry_pb2.Matrix, field: str) -> object:
    if len(matrix.values) != 16:
        raise InvalidPose(f"{field} must hold 16 numbers, row by row, got {len(matrix.values)}", field=field)
    return rows(np.reshape(matrix.values, (4, 4)))
