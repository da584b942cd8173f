"""A scene that a job made becomes one that is served: one rename or link, and never over another scene."""

from __future__ import annotations

from ultragray.files.atomic import file_sha256
from ultragray.files.link import link_or_copy

from ..errors import SceneExists
from ..scenes import SUFFIX
from .folder import JobFolder

SCENES_FOLDER = "scenes"  # of the artifact folder: scenes that jobs made


def publish_scene(folder: JobFolder, scene: str) -> None:
    """Serves the scene among the job's artifacts; nothing where it is served already.

    Raises SceneExists where another scene has the name, OSError.
    """
    target = folder.artifact_folder / SCENES_FOLDER / f"{scene}{SUFFIX}"
    target.parent.mkdir(parents=True, exist_ok=True)
    made = folder.artifacts / target.name
    link_or_copy(made, target)
    if file_sha256(target) != file_sha256(made):
        raise SceneExists(f"a scene {scene!r} appeared while this job made another: choose another name", field="scene")
