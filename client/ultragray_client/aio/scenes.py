"""The scenes of a service."""

from __future__ import annotations

from ..connection import Pages
from ..scenes import Scene, SceneEntry, get_scene, list_scenes, load_scene, unload_scene
from .connection import AsyncConnection


class AsyncScenes:
    """`client.scenes`. All raise ClientError; a name that does not exist is SceneNotFound."""

    def __init__(self, connection: AsyncConnection) -> None:
        self._connection = connection

    async def list(self, *, timeout_s: float | None = None) -> tuple[SceneEntry, ...]:
        """All scenes by name."""
        return await self._connection.all_pages(Pages(list_scenes, None), timeout_s)

    async def get(self, name: str, *, timeout_s: float | None = None) -> Scene:
        """What a scene says about itself."""
        return await self._connection.answer(get_scene(name), timeout_s)

    async def load(self, name: str, *, timeout_s: float | None = None) -> int:
        """Loads a scene ahead of its first frame; the number of render processes that hold it."""
        return await self._connection.answer(load_scene(name), timeout_s)

    async def unload(self, name: str, *, timeout_s: float | None = None) -> int:
        """Frees a scene's memory; the number of render processes that still hold it."""
        return await self._connection.answer(unload_scene(name), timeout_s)
