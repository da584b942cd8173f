# Generated from aio/registrations.py by client/generate.py; change that file.
"""The registrations of a service."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray_client.records import Registration
from ultragray_proto.codec import from_message
from ultragray_proto.v1 import geometry_pb2, registrations_pb2, registrations_pb2_grpc

from ..errors import InvalidPose
from ..messages import message_of
from .connection import Connection


class Registrations:
    """`client.registrations`. All raise ClientError; a name that does not exist is RegistrationNotFound."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._calls = registrations_pb2_grpc.RegistrationServiceStub(connection.channel)

    def list(self, *, timeout_s: float | None = None) -> tuple[Registration, ...]:
        """All registrations that the key may see, by name."""
        request = registrations_pb2.ListRegistrationsRequest()
        found = self._connection.listed(self._calls.ListRegistrations, request, "registrations", timeout_s)
        return tuple(from_message(one, Registration) for one in found)

    def get(self, name: str, *, timeout_s: float | None = None) -> Registration:
        """One registration."""
        request = registrations_pb2.GetRegistrationRequest(registration=name)
        return from_message(self._connection.answer(self._calls.GetRegistration, request, timeout_s), Registration)

    def put(
        self,
        name: str,
        scene: str,
        base_to_scene: npt.ArrayLike,
        probe_to_flange: npt.ArrayLike | None = None,
        *,
        quality: Mapping[str, Any] | None = None,
        timeout_s: float | None = None,
    ) -> Registration:
        """Keeps a registration of a scene, in place of one of that name which is the key's own.

        Both links are [4, 4], mm; without `probe_to_flange` the probe's frame is the flange's. `quality` may hold
        residual_mm, residual_deg, position_std_mm and angle_std_deg, as the file of `ultragray calibrate` does.
        Raises InvalidPose, SceneNotFound, PermissionDenied, LimitReached.
        """
        links = {"base_to_scene": base_to_scene, "probe_to_flange": probe_to_flange}
        matrices = {link: _matrix(pose, link) for link, pose in links.items() if pose is not None}
        known = {key: value for key, value in (quality or {}).items() if key in _QUALITY}
        content = message_of(known, registrations_pb2.Registration, scene=scene, **matrices)
        request = registrations_pb2.PutRegistrationRequest(registration=name, content=content)
        return from_message(self._connection.answer(self._calls.PutRegistration, request, timeout_s), Registration)

    def delete(self, name: str, *, timeout_s: float | None = None) -> None:
        """Forgets a registration."""
        request = registrations_pb2.DeleteRegistrationRequest(registration=name)
        self._connection.answer(self._calls.DeleteRegistration, request, timeout_s)


_QUALITY = ("residual_mm", "residual_deg", "position_std_mm", "angle_std_deg")


def _matrix(pose: npt.ArrayLike, field: str) -> geometry_pb2.Matrix:
    try:
        matrix = np.asarray(pose, np.float64)
    except (TypeError, ValueError):
        raise InvalidPose(f"{field} must be numbers [4, 4], got {type(pose).__name__}", field=field) from None
    if matrix.shape != (4, 4):
        raise InvalidPose(f"{field} must be [4, 4], got {list(matrix.shape)}", field=field)
    return geometry_pb2.Matrix(values=matrix.ravel().tolist())
