"""The scenes of a running service, and frames of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray
from ultragray_service.remote.connection import Connection, Count, route


@dataclass(frozen=True)
class Answer:
    """Rendered frames as the service encoded them, and what its headers say about them."""

    data: bytes
    headers: dict[str, str]

    def fact(self, name: str) -> Any:
        """A header that holds JSON, by the end of its name; None where it is not there."""
        text = self.headers.get(f"x-ultragray-{name}")
        return None if text is None else json.loads(text)


class Scenes:
    """Asks for scenes over a connection, and raises as it does."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def all(self) -> list[dict[str, Any]]:
        """Every scene, by name."""
        return self._connection.listed("/v1/scenes", "scenes")

    def get(self, name: str) -> dict[str, Any]:
        """All that a scene says about itself."""
        found: dict[str, Any] = self._connection.json("GET", route("scenes", name))
        return found

    def training_poses(self, name: str) -> FloatArray:  # [P, 4, 4] mm
        """The poses that it was trained from, at most 10,000 of them."""
        found = self._connection.json("GET", route("scenes", name, "training-poses"))
        return check_poses(np.array(found["poses"], np.float64).reshape(-1, 4, 4))

    def delete(self, name: str) -> None:
        """Delete a scene that was imported or trained."""
        self._connection.json("DELETE", route("scenes", name))

    def upload(self, name: str, path: Path, count: Count, *, private: bool) -> dict[str, Any]:
        """Have the service take a scene file in."""
        suffix = "?private=true" if private else ""
        scene, _ = self._connection.upload(route("scenes", name, suffix=suffix), path, count)
        found: dict[str, Any] = scene
        return found

    def download(self, name: str, path: Path, progress: Callable[[int | None], Count]) -> int:
        """Write a scene file to `path`, whole or not at all; its size in bytes."""
        return self._connection.download(route("scenes", name, "file"), path, progress)

    def render(self, name: str, body: dict[str, Any], media_type: str) -> Answer:
        """The frames of a request, as the body of a render route."""
        with self._connection.open("POST", route("scenes", name, "render"), body, accept=media_type) as answer:
            return Answer(self._connection.whole(answer), {key.lower(): value for key, value in answer.headers.items()})
