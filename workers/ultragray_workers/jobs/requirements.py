"""Needs of a job, whatever its kind: checked at its submission, and the scene kept for it. Free of torch."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ultragray.geometry.registration import Registration
from ultragray.scene.info import SceneHeader, read_header
from ultragray_workers.claims import storage_full
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import SceneExists
from ultragray_workers.jobs.files import JobFiles
from ultragray_workers.jobs.kinds import Specification
from ultragray_workers.jobs.kinds.base import Surroundings
from ultragray_workers.jobs.owners import Kind
from ultragray_workers.scene_names import base_name
from ultragray_workers.scenes import SceneStore


@dataclass(frozen=True)
class Requirements:
    """The datasets, scenes and registrations that jobs name."""

    datasets: DatasetStore
    scenes: SceneStore
    registration: Callable[[str, str], Registration]  # finds that of a name, for a scene
    files: JobFiles
    free_bytes: Callable[[], int | None]  # of the storage of the files; None: not known
    max_image_side: int

    def provide(self, specification: Specification, job_id: str, before: str | None) -> None:
        """Keeps the scene that the job needs, as it is now, for the job, once the job can be done.

        `before`: the job that it replaces, whose scene is taken where it is still there. Raises DatasetNotFound,
        DatasetInvalid, SceneExists, SceneNotFound, SceneFileInvalid, StorageFull, StorageUnavailable and what `check`
        of the specification raises.
        """
        self.require_dataset(specification)
        made = _named(specification, specification.makes_scene)
        if made is not None and made in self.scenes.names():
            raise SceneExists(
                f"there is already a scene {made!r}: choose another name", field=specification.makes_scene
            )
        name = _named(specification, specification.needs_scene)
        if name is None:
            specification.check(self._surroundings(None))
            return
        with self._kept(name, before) as old:
            if old is not None:
                path, header = old, read_header(old)
            else:
                path, header = self.scenes.path(name), self.scenes.header(name)
            with storage_full("the scene of the job"):
                specification.check(self._surroundings(header))
                try:
                    self.files.keep_scene(path, name, job_id)
                except FileNotFoundError:
                    self.scenes.path(name)  # raises SceneNotFound where the scene has just gone
                    raise

    def placed(self, specification: Specification) -> Specification:
        """The job with its poses brought into its scene by the registration that it names, as that is now.

        Raises SceneNotFound, RegistrationNotFound, and InvalidArgument for one of another scene.
        """
        name = _named(specification, specification.needs_registration)
        if name is None:
            return specification
        scene = _named(specification, specification.needs_scene)
        self.scenes.path(scene)
        return specification.registered(self.registration(name, scene))

    def taken(self, specification: Specification, before: str | None) -> list[tuple[Kind, str]]:
        """The dataset and the scene that `provide` takes; not a scene that the job replaced has kept."""
        dataset, scene = (
            _named(specification, one) for one in (specification.needs_dataset, specification.needs_scene)
        )
        found = [] if dataset is None else [(Kind.DATASET, dataset)]
        if scene is None:
            return found
        with self._kept(scene, before) as kept:
            return found if kept is not None else [*found, (Kind.SCENE, base_name(scene))]

    def require_dataset(self, specification: Specification) -> None:
        """Raises DatasetNotFound, DatasetInvalid where the job's dataset is not there."""
        if (dataset := _named(specification, specification.needs_dataset)) is not None:
            self.datasets.get(dataset)

    def _surroundings(self, scene: SceneHeader | None) -> Surroundings:
        return Surroundings(scene, self.free_bytes(), self.max_image_side)

    def _kept(self, scene: str, before: str | None) -> AbstractContextManager[Path | None]:
        """The scene that was kept for the job that is replaced; None where it is not there."""
        return nullcontext() if before is None else self.files.kept_scene(before, scene)


def _named(specification: Specification, field: str | None) -> Any:
    return None if field is None else getattr(specification, field)
