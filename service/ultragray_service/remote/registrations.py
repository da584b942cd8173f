"""The registrations of a running service."""

from __future__ import annotations

from typing import Any

from ultragray.contract import to_dict
from ultragray.geometry.registration import Registration
from ultragray_service.remote.connection import Connection, route


class Registrations:
    """Asks for registrations over a connection, and raises as it does."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def all(self) -> list[dict[str, Any]]:
        """Every registration, by name."""
        return self._connection.listed("/v1/registrations", "registrations")

    def get(self, name: str) -> dict[str, Any]:
        """One registration."""
        found: dict[str, Any] = self._connection.json("GET", route("registrations", name))
        return found

    def put(self, name: str, scene: str, registration: Registration) -> dict[str, Any]:
        """Have the service keep a registration of a scene, in place of one of that name."""
        body = {"scene": scene, **to_dict(registration, with_none=False)}
        kept: dict[str, Any] = self._connection.json("PUT", route("registrations", name), body)
        return kept

    def delete(self, name: str) -> None:
        """Have the service forget a registration."""
        self._connection.json("DELETE", route("registrations", name))
