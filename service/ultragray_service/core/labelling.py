"""Labels for the Gaussians of a scene, as all front doors ask for them: a scene of another name, or in its place."""

from __future__ import annotations

import asyncio
import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ultragray.contract import Contract, described, to_dict
from ultragray.errors import InvalidArgument, SceneFileInvalid
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.scene.info import DEFAULT_WITHIN_MM, MAX_WITHIN_MM
from ultragray_service.access.audit import account
from ultragray_service.access.owners import Owners
from ultragray_service.core.life import Life
from ultragray_service.core.registrations import Registrations
from ultragray_service.core.scenes import Scene, scene_to_blame
from ultragray_service.core.threads import HelperProcesses
from ultragray_service.core.uploads import SceneImports
from ultragray_workers.jobs.owners import Kind
from ultragray_workers.scene_labels import label_scene
from ultragray_workers.scenes import SceneStore

LABELLING_TIMEOUT_S = 600.0
MAX_PAINTED_FRAMES = 200


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


class SceneLabels:
    """Labels scenes in helper processes, one after another."""

    def __init__(
        self,
        store: SceneStore,
        imports: SceneImports,
        registrations: Registrations,
        owners: Owners,
        processes: HelperProcesses,
        life: Life,
    ) -> None:
        self._store, self._imports, self._registrations = store, imports, registrations
        self._owners, self._processes, self._life = owners, processes, life

    async def by_frames(
        self,
        scene: str,
        target: LabelTarget,
        frames: Sequence[tuple[FloatArray, bytes]],  # poses [4, 4] mm, PNG files
        probe: Probe | None,
        registration: str | None,
    ) -> Scene:
        """By painted frames, whose poses a registration leads into the scene.

        Raises what `label_by_frames` and `_label` raise.
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

    async def by_map(self, scene: str, target: LabelTarget, nifti: bytes, registration: str | None) -> Scene:
        """By a NIfTI file, which a registration leads into the scene.

        Raises what `read_label_map`, `label_by_map` and `_label` raise.
        """
        base_to_scene = None
        if registration is not None:
            link = await self._registrations.of_scene(registration, scene)
            base_to_scene = [list(row) for row in link.base_to_scene]
        return await self._label(scene, target, frames=[], probe=None, map_to_scene=base_to_scene, nifti=nifti)

    async def _label(self, scene: str, target: LabelTarget, *, nifti: bytes | None = None, **arguments: Any) -> Scene:
        """Raises SceneNotFound, SceneExists, SceneReadOnly, PermissionDenied, RegistrationNotFound, LimitReached."""
        self._life.require_serving()
        account().target = target.into
        with scene_to_blame():
            source = await asyncio.to_thread(self._store.path, scene)

        async def make(made: Path, replaced: Path | None) -> None:
            label_map = None
            if nifti is not None:
                label_map = made.with_name("labels.nii.gz" if nifti.startswith(b"\x1f\x8b") else "labels.nii")
                await asyncio.to_thread(label_map.write_bytes, nifti)
            await self._processes.run(
                label_scene,
                {
                    "scene": str(source),
                    "output": str(made),
                    "replaced": None if replaced is None else str(replaced),
                    "names": {str(label): name for label, name in target.label_names.items()},
                    "within_mm": target.within_mm,
                    "label_map": None if label_map is None else str(label_map),
                    **arguments,
                },
                what="labelling the scene",
                timeout_s=LABELLING_TIMEOUT_S,
                killed=SceneFileInvalid,
            )

        header = await self._imports.make(target.into, make, replace=target.replace, private=target.private)
        return Scene.of(target.into, header, 0, self._owners.known(Kind.SCENE, target.into))
