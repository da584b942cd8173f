# Generated from aio/scenes.py by client/generate.py; change that file.
"""The scenes of a service."""

from __future__ import annotations

from ..connection import Pages
from ..scenes import Scene, SceneEntry, get_scene, list_scenes, load_scene, unload_scene
from .connection import Connection


class Scenes:
    """`client.scenes`. All raise ClientError; a name that does not exist is SceneNotFound."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def list(self, *, timeout_s: float | None = None) -> tuple[SceneEntry, ...]:
        """All scenes by name."""
        return self._connection.all_pages(Pages(list_scenes, None), timeout_s)

    def get(self, name: str, *, timeout_s: float | None = None) -> Scene:
        """What a scene says about itself."""
        return self._connection.answer(get_scene(name), timeout_s)

    def load(self, name: str, *, timeout_s: float | None = None) -> int:
        """Loads a scene ahead of its first frame; the number of render processes that hold it."""
        return self._connection.answer(load_scene(name), timeout_s)

    def unload(self, name: str, *, timeout_s: float | None = None) -> int:
        """Frees a scene's memory; the number of render processes that still hold it."""
        return self._connection.answer(unload_scene(name), timeout_s)
