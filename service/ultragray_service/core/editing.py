"""Scenes made of scenes, as all front doors ask for them: labelled, edited, or made from labels that nobody recorded.

Each becomes a scene of another name, which tells what it was made of; a labelled one may take the place of its like.
"""

from __future__ import annotations

import asyncio
import base64
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from ultragray.contract import Contract, described, made_of, to_dict
from ultragray.errors import InvalidArgument, SceneFileInvalid
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.scene.edits import MAX_EDITS, Edit, check_edits, scenes_named
from ultragray.scene.info import DEFAULT_WITHIN_MM, MAX_WITHIN_MM
from ultragray.scene.recipes import SceneRecipe
from ultragray_service.access.audit import account
from ultragray_service.access.owners import Owners
from ultragray_service.core.life import Life
from ultragray_service.core.registrations import Registrations
from ultragray_service.core.scenes import Scene, scene_to_blame
from ultragray_service.core.threads import HelperProcesses
from ultragray_service.core.uploads import Make, SceneImports
from ultragray_workers.jobs.owners import Kind
from ultragray_workers.scene_edits import edit_scene_file, label_scene, make_scene_file
from ultragray_workers.scenes import SceneStore

TIMEOUT_S = 600.0
MAX_PAINTED_FRAMES = 200


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


@dataclass(frozen=True, kw_only=True)
class LabelTarget(Contract):
    """Where labels go, and what they are called."""

    into: str = described("The scene to make: the same Gaussians, with the labels.")
    replace: bool = described(
        "Whether `into` may be a scene that is there, the caller's own, with the same Gaussians: it gets the labels.",
        False,
    )
    private: bool = described("Whether others may not see a scene that is made.", False)
    label_names: dict[int, str] = described("By label, 1 to 254, beside those of the scene.", factory=dict)
    within_mm: float = described(
        "Gaussians that nothing labels take the label of labelled ones that lie within, and echo alike; 0: none do.",
        DEFAULT_WITHIN_MM,
        low=0.0,
        high=MAX_WITHIN_MM,
    )


def check_painted_count(count: int) -> None:
    if not 1 <= count <= MAX_PAINTED_FRAMES:
        raise InvalidArgument(f"frames must be 1 to {MAX_PAINTED_FRAMES}, got {count}", field="frames")


Target: TypeAlias = EditTarget | RecipeTarget | LabelTarget


class SceneEdits:
    """Makes scenes in helper processes: labelling in one, all else in another, one after another in each."""

    def __init__(
        self,
        store: SceneStore,
        imports: SceneImports,
        registrations: Registrations,
        owners: Owners,
        editing: HelperProcesses,
        labelling: HelperProcesses,
        life: Life,
    ) -> None:
        self._store, self._imports, self._registrations, self._owners = store, imports, registrations, owners
        self._editing, self._labelling, self._life = editing, labelling, life

    async def edit(self, scene: str, target: EditTarget) -> Scene:
        """Raises SceneNotFound, SceneExists, LimitReached, QueueFull, and what `edit_scene` raises."""
        check_edits(target.edits)
        self._begin(target)
        scenes = {name: await self._path(name) for name in dict.fromkeys((scene, *scenes_named(target.edits)))}

        async def edit(output: Path, replaced: Path | None) -> None:
            arguments = {"output": str(output), "scenes": scenes, "edits": to_dict(target.edits)}
            await _run(self._editing, edit_scene_file, arguments, "editing the scene")

        return await self._new_scene(target, edit)

    async def make(self, target: RecipeTarget) -> Scene:
        """Raises SceneExists, LimitReached, QueueFull, and what `scene_from_labels` raises."""
        self._begin(target)

        async def make(output: Path, replaced: Path | None) -> None:
            arguments = {"output": str(output), "recipe": to_dict(made_of(SceneRecipe, target))}
            await _run(self._editing, make_scene_file, arguments, "making the scene")

        return await self._new_scene(target, make)

    async def label_by_frames(
        self,
        scene: str,
        target: LabelTarget,
        frames: Sequence[tuple[FloatArray, bytes]],  # poses [4, 4] mm, PNG files
        probe: Probe | None,
        registration: str | None,
    ) -> Scene:
        """By painted frames, whose poses a registration leads into the scene.

        Raises what `learn.labelling.label_by_frames` and `_label` raise.
        """
        check_painted_count(len(frames))
        link = None if registration is None else await self._registrations.of_scene(registration, scene)
        painted = [
            {
                "pose": (pose if link is None else link.probe_to_scene(pose)).tolist(),
                "labels": base64.b64encode(labels).decode(),
            }
            for pose, labels in frames
        ]
        asked_probe = None if probe is None else to_dict(probe)
        return await self._label(scene, target, frames=painted, probe=asked_probe, map_to_scene=None)

    async def label_by_map(self, scene: str, target: LabelTarget, nifti: bytes, registration: str | None) -> Scene:
        """By a NIfTI file, which a registration leads into the scene.

        Raises what `read_label_map`, `learn.labelling.label_by_map` and `_label` raise.
        """
        base_to_scene = None
        if registration is not None:
            link = await self._registrations.of_scene(registration, scene)
            base_to_scene = [list(row) for row in link.base_to_scene]
        return await self._label(scene, target, frames=[], probe=None, map_to_scene=base_to_scene, nifti=nifti)

    async def _label(self, scene: str, target: LabelTarget, *, nifti: bytes | None = None, **arguments: Any) -> Scene:
        """Raises SceneNotFound, SceneExists, SceneReadOnly, PermissionDenied, RegistrationNotFound, LimitReached."""
        self._begin(target)
        arguments |= {
            "scene": await self._path(scene),
            "names": {str(label): name for label, name in target.label_names.items()},
            "within_mm": target.within_mm,
        }

        async def label(output: Path, replaced: Path | None) -> None:
            label_map = None
            if nifti is not None:
                label_map = output.with_name("labels.nii.gz" if nifti.startswith(b"\x1f\x8b") else "labels.nii")
                await asyncio.to_thread(label_map.write_bytes, nifti)
            files = {"output": output, "replaced": replaced, "label_map": label_map}
            paths = {name: None if path is None else str(path) for name, path in files.items()}
            await _run(self._labelling, label_scene, {**arguments, **paths}, "labelling the scene")

        return await self._new_scene(target, label, replace=target.replace)

    def _begin(self, target: Target) -> None:
        self._life.require_serving()
        account().target = target.into

    async def _path(self, scene: str) -> str:
        with scene_to_blame():
            return str(await asyncio.to_thread(self._store.path, scene))

    async def _new_scene(self, target: Target, make: Make, *, replace: bool = False) -> Scene:
        header = await self._imports.make(target.into, make, replace=replace, private=target.private)
        return Scene.of(target.into, header, 0, self._owners.known(Kind.SCENE, target.into))


async def _run(processes: HelperProcesses, work: Callable[..., None], arguments: dict[str, Any], what: str) -> None:
    await processes.run(work, arguments, what=what, timeout_s=TIMEOUT_S, killed=SceneFileInvalid)
