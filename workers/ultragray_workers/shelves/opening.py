"""Scenes that jobs made: where they become scenes that are served."""

from __future__ import annotations

from pathlib import Path

from ultragray_workers.shelves.folder import FolderShelf
from ultragray_workers.shelves.index import SceneIndex
from ultragray_workers.storage.storage import Storage

SCENES_FOLDER = "scenes"  # prefix of keys


def publish_made(storage: Storage, file: Path, name: str) -> None:
    """Serves a file as a scene: one link or one conditional write, never over another scene.

    Nothing where it is served already. Raises SceneExists where another scene has the name, StorageUnavailable,
    OSError.
    """
    if storage.local is None:
        SceneIndex(storage, SCENES_FOLDER).publish(file, name)
    else:
        FolderShelf(storage.local / SCENES_FOLDER).publish(file, name)
