"""A scene that a job made becomes one that is served: one rename or link, and never over another scene.

The job has its name from the submission on, and gives it back where it ends without the scene.
"""

from __future__ import annotations

from pathlib import Path

from ultragray.files.atomic import file_sha256
from ultragray.files.link import link_or_copy

from ..errors import SceneExists
from ..scenes import SUFFIX
from .folder import JobFolder
from .queue.database import JobDatabase
from .queue.owners import Kind, Ownership, claim_of_job, forget_owner

SCENES_FOLDER = "scenes"  # of the artifact folder: scenes that jobs made


def publish_scene(folder: JobFolder, scene: str) -> None:
    """Serves the scene among the job's artifacts; nothing where it is served already.

    Raises SceneExists where another scene has the name, OSError.
    """
    target = _target(folder, scene)
    target.parent.mkdir(parents=True, exist_ok=True)
    made = folder.artifacts / target.name
    link_or_copy(made, target)
    if file_sha256(target) != file_sha256(made):
        raise SceneExists(f"a scene {scene!r} appeared while this job made another: choose another name", field="scene")


def give_name_back(jobs: JobDatabase, folder: JobFolder, scene: str, owner: str | None) -> None:
    """Forgets whose the scene was to be of a job that has ended, unless it is served."""
    served, made = _target(folder, scene), folder.artifacts / f"{scene}{SUFFIX}"
    if not (served.is_file() and made.is_file() and file_sha256(served) == file_sha256(made)):
        with jobs.engine.begin() as connection:
            forget_owner(connection, Kind.SCENE, scene, Ownership(owner, claim=claim_of_job(folder.job_id)))


def _target(folder: JobFolder, scene: str) -> Path:
    return folder.artifact_folder / SCENES_FOLDER / f"{scene}{SUFFIX}"
