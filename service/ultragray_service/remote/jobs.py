"""The jobs of a running service."""

from __future__ import annotations

import http.client
import json
from collections.abc import Callable, Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any

from ultragray_service.remote.connection import Connection, Count, route


class Jobs:
    """Asks for jobs over a connection, and raises as it does."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def submit(self, body: dict[str, Any]) -> tuple[dict[str, Any], bool]:
        """The job, and whether it is new."""
        job, status = self._connection.answered("POST", "/v1/jobs", body)
        return job, status == HTTPStatus.CREATED

    def get(self, job_id: str) -> dict[str, Any]:
        """The job as it is now."""
        found: dict[str, Any] = self._connection.json("GET", route("jobs", job_id))
        return found

    def cancel(self, job_id: str) -> dict[str, Any]:
        """The job, cancelled."""
        found: dict[str, Any] = self._connection.json("POST", route("jobs", job_id, suffix=":cancel"))
        return found

    def retry(self, job_id: str) -> dict[str, Any]:
        """The job in its place."""
        found: dict[str, Any] = self._connection.json("POST", route("jobs", job_id, suffix=":retry"))
        return found

    def delete(self, job_id: str) -> None:
        """Remove a finished job and its files."""
        self._connection.json("DELETE", route("jobs", job_id))

    def newest(self, *, state: str, kind: str, limit: int) -> list[dict[str, Any]]:
        """The newest jobs, at most `limit`."""
        return self._connection.listed("/v1/jobs", "jobs", limit, state=state, kind=kind)

    def log(self, job_id: str, max_bytes: int) -> str:
        """The end of its log."""
        suffix = f"/log?max_bytes={max_bytes}"
        with self._connection.open("GET", route("jobs", job_id, suffix=suffix), accept="*/*") as answer:
            return self._connection.whole(answer).decode("utf-8", "replace")

    def download(self, job_id: str, name: str, path: Path, progress: Callable[[int | None], Count]) -> int:
        """Write an artifact to `path`, whole or not at all; its size in bytes."""
        return self._connection.download(route("jobs", job_id, "artifacts", name), path, progress)

    def changes(self, job_id: str) -> Iterator[dict[str, Any]]:
        """The job at first and whenever it changed; ends after its final state, or where the service goes away."""
        with self._connection.open("GET", route("jobs", job_id, "events"), accept="text/event-stream") as answer:
            event = ""
            try:
                for line in answer:
                    name, _, value = line.decode("utf-8", "replace").rstrip("\r\n").partition(": ")
                    if name == "event":
                        event = value
                    elif name == "data" and event == "progress":
                        yield json.loads(value)
            except (OSError, http.client.HTTPException):
                return
