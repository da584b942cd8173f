"""Edits of scenes, and scenes made from labels, as all front doors ask for them: a scene of another name, which tells
what it was made of.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ultragray.contract import Contract, described, to_dict
from ultragray.errors import SceneFileInvalid
from ultragray.scene.edits import MAX_EDITS, Edit, check_edits, scenes_named
from ultragray.scene.recipes import SceneRecipe
from ultragray_service.access.audit import account
from ultragray_service.access.owners import Owners
from ultragray_service.core.life import Life
from ultragray_service.core.scenes import Scene, scene_to_blame
from ultragray_service.core.threads import HelperProcesses
from ultragray_service.core.uploads import SceneImports
from ultragray_workers.jobs.owners import Kind
from ultragray_workers.scene_edits import edit_scene_file, make_scene_file
from ultragray_workers.scenes import SceneStore

EDITING_TIMEOUT_S = 600.0


@dataclass(frozen=True, kw_only=True)
class EditTarget(Contract):
    """What is to be done to a scene, and the scene to make of it."""

    into: str = described("The scene to make.")
    edits: tuple[Edit, ...] = described("One after another.", most=MAX_EDITS)
    private: bool = described("Whether others may not see it.", False)


@dataclass(frozen=True, kw_only=True)
class RecipeTarget(SceneRecipe):
    """A recipe, and the scene to make by it."""

    into: str = described("The scene to make.")
    private: bool = described("Whether others may not see it.", False)


class SceneEdits:
    """Edits scenes, and makes them from labels, in helper processes, one after another."""

    def __init__(
        self, store: SceneStore, imports: SceneImports, owners: Owners, processes: HelperProcesses, life: Life
    ) -> None:
        self._store, self._imports, self._owners = store, imports, owners
        self._processes, self._life = processes, life

    async def edit(self, scene: str, target: EditTarget) -> Scene:
        """Raises SceneNotFound, SceneExists, LimitReached, QueueFull, and what `edit_scene` raises."""
        check_edits(target.edits)
        self._life.require_serving()
        account().target = target.into
        with scene_to_blame():
            names = dict.fromkeys((scene, *scenes_named(target.edits)))
            scenes = {name: str(await asyncio.to_thread(self._store.path, name)) for name in names}

        edits = to_dict(target.edits)
        return await self._made(target, edit_scene_file, "editing the scene", scenes=scenes, edits=edits)

    async def make(self, target: RecipeTarget) -> Scene:
        """Raises SceneExists, LimitReached, QueueFull, and what `scene_from_labels` raises."""
        self._life.require_serving()
        account().target = target.into
        recipe = {item.name: to_dict(getattr(target, item.name)) for item in fields(SceneRecipe)}
        return await self._made(target, make_scene_file, "making the scene", recipe=recipe)

    async def _made(
        self, target: EditTarget | RecipeTarget, work: Callable[..., None], what: str, **arguments: Any
    ) -> Scene:
        async def make(made: Path, replaced: Path | None) -> None:
            await self._processes.run(
                work,
                {"output": str(made), **arguments},
                what=what,
                timeout_s=EDITING_TIMEOUT_S,
                killed=SceneFileInvalid,
            )

        header = await self._imports.make(target.into, make, replace=False, private=target.private)
        return Scene.of(target.into, header, 0, self._owners.known(Kind.SCENE, target.into))
