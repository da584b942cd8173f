"""A scene that a job made becomes one that is served: one link or one conditional write, never over another scene.

The job has its name from the submission on, and gives it back where it ends without the scene.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ultragray.files import file_sha256
from ultragray_workers.errors import SceneExists
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.queue.database import JobDatabase
from ultragray_workers.jobs.queue.owners import Kind, Ownership, claim_of_job, forget_owner
from ultragray_workers.scene_names import SUFFIX
from ultragray_workers.shelves.folder import FolderShelf
from ultragray_workers.shelves.index import SceneIndex
from ultragray_workers.storage.storage import Storage

SCENES_FOLDER = "scenes"  # of the artifact folder: scenes that jobs made


def publish_scene(folder: JobFolder, scene: str, shared: Storage | None = None) -> None:
    """Serves the scene among the job's artifacts; nothing where it is served already.

    `shared`: the storage whose scenes it becomes one of; None: those of the artifact folder. Raises SceneExists where
    another scene has the name, StorageUnavailable, OSError.
    """
    try:
        _publish_into(folder, shared)(folder.artifacts / f"{scene}{SUFFIX}", scene)
    except SceneExists:
        raise SceneExists(
            f"a scene {scene!r} appeared while this job made another: choose another name", field="scene"
        ) from None


def give_name_back(
    jobs: JobDatabase, folder: JobFolder, scene: str, owner: str | None, shared: Storage | None = None
) -> None:
    """Forgets whose the scene was to be of a job that has ended, unless it is served. Raises StorageUnavailable."""
    made = folder.artifacts / f"{scene}{SUFFIX}"
    served = _served_sha256(folder, scene, shared)
    # Another host may have what the job made; as long as the name is the job's, nobody else could publish one of it.
    is_served = served == file_sha256(made) if made.is_file() else shared is not None and served is not None
    if not is_served:
        with jobs.engine.begin() as connection:
            forget_owner(connection, Kind.SCENE, scene, Ownership(owner, claim=claim_of_job(folder.job_id)))


def _publish_into(folder: JobFolder, shared: Storage | None) -> Callable[[Path, str], None]:
    if shared is None:
        return FolderShelf(folder.artifact_folder / SCENES_FOLDER).publish
    return SceneIndex(shared, SCENES_FOLDER).publish


def _served_sha256(folder: JobFolder, scene: str, shared: Storage | None) -> str | None:
    if shared is not None:
        placed = SceneIndex(shared, SCENES_FOLDER).look_up(scene)
        return None if placed is None else placed.sha256
    served = FolderShelf(folder.artifact_folder / SCENES_FOLDER).here(scene)
    return None if served is None else file_sha256(served)
