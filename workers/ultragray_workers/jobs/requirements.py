"""Needs of a job, whatever its kind: checked at its submission, and the scene kept for it. Free of torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ultragray.files.atomic import sync
from ultragray.files.link import link_or_copy
from ultragray.scene_info import SceneHeader, read_header

from ..claims import storage_full
from ..datasets.store import DatasetStore
from ..errors import SceneExists
from ..scene_names import SUFFIX, base_name
from ..scenes import SceneStore
from .folder import JobFolder
from .kinds import Specification
from .kinds.base import Surroundings
from .queue.owners import Kind


@dataclass(frozen=True)
class Requirements:
    """The datasets and scenes that jobs name."""

    datasets: DatasetStore
    scenes: SceneStore
    artifact_folder: Path
    max_image_side: int

    def provide(self, specification: Specification, folder: JobFolder, before: JobFolder | None) -> None:
        """Puts the scene that the job needs, as it is now, into the folder of the job, once the job can be done.

        `before`: the folder of the job that it replaces, whose scene is taken where it is still there. Raises
        DatasetNotFound, DatasetInvalid, SceneExists, SceneNotFound, SceneFileInvalid, StorageFull and what `check` of
        the specification raises.
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
        if (old := _kept(name, before)) is not None:
            path, header = old, read_header(old)
        else:
            path, header = self.scenes.path(name), self.scenes.header(name)
        with storage_full("the scene of the job"):
            specification.check(self._surroundings(header))
            self._keep(path, name, folder)

    def taken(self, specification: Specification, before: JobFolder | None) -> list[tuple[Kind, str]]:
        """The dataset and the scene that `provide` takes; not a scene that the job replaced has kept."""
        dataset, scene = (
            _named(specification, one) for one in (specification.needs_dataset, specification.needs_scene)
        )
        found = [] if dataset is None else [(Kind.DATASET, dataset)]
        return found if scene is None or _kept(scene, before) is not None else [*found, (Kind.SCENE, base_name(scene))]

    def require_dataset(self, specification: Specification) -> None:
        """Raises DatasetNotFound, DatasetInvalid where the job's dataset is not there."""
        if (dataset := _named(specification, specification.needs_dataset)) is not None:
            self.datasets.get(dataset)

    def _surroundings(self, scene: SceneHeader | None) -> Surroundings:
        return Surroundings(scene, self.artifact_folder, self.max_image_side)

    def _keep(self, path: Path, name: str, folder: JobFolder) -> None:
        folder.path.mkdir(parents=True, exist_ok=True)
        sync(folder.path.parent)
        kept = folder.path / f"{name}{SUFFIX}"
        new = kept.with_name(f".{kept.name}")
        try:
            new.unlink(missing_ok=True)
            link_or_copy(path, new)
        except FileNotFoundError:
            self.scenes.path(name)  # raises SceneNotFound where the scene has just gone
            raise
        new.replace(kept)  # a submission that failed may have left another scene
        new.unlink(missing_ok=True)  # or the same: renaming one link of a file to another does nothing
        sync(folder.path)


def _named(specification: Specification, field: str | None) -> Any:
    return None if field is None else getattr(specification, field)


def _kept(scene: str, before: JobFolder | None) -> Path | None:
    """The file of a scene in the folder of the job that is replaced; None where it is not there."""
    kept = None if before is None else before.path / f"{scene}{SUFFIX}"
    return kept if kept is not None and kept.is_file() else None
