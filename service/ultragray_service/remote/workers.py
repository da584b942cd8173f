"""The workers of a running service."""

from __future__ import annotations

from typing import Any

from ultragray_service.remote.connection import Connection, route


class Workers:
    """Asks for workers over a connection, and raises as it does."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def all(self) -> list[dict[str, Any]]:
        """The workers by name, also those that were lost within a day."""
        found: list[dict[str, Any]] = self._connection.json("GET", "/v1/workers")["workers"]
        return found

    def want(self, name: str, wish: str) -> dict[str, Any]:
        """A worker that was told to `pause`, `drain` or `resume`."""
        found: dict[str, Any] = self._connection.json("POST", route("workers", name, suffix=f":{wish}"))
        return found
