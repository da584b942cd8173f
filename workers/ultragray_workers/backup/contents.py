"""The files that belong to a backup: scenes, datasets and jobs, without locks, caches and half made things."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ultragray_workers.datasets.store import FILES, MANIFESTS
from ultragray_workers.jobs.files import FOLDER as JOBS
from ultragray_workers.scene_shelf import SCENES_FOLDER
from ultragray_workers.scenes import SUFFIX, SceneStore
from ultragray_workers.storage.local import FileVersion
from ultragray_workers.store import MARKER

DATA, ARTIFACTS = "data", "artifacts"
_OF_A_PROCESS = (".lock", ".tmp", ".new")


@dataclass(frozen=True)
class StoredFile:
    root: str
    path: PurePosixPath  # below it
    source: Path

    @property
    def grows(self) -> bool:
        """Whether somebody may be writing at its end."""
        return self.path.suffix == ".log"

    def version(self) -> FileVersion:
        """Tells one content from the next, without reading it. Raises OSError."""
        return FileVersion.of(self.source)


@dataclass(frozen=True)
class Folders:
    data: Path
    artifacts: Path

    def root(self, name: str) -> Path:
        return {DATA: self.data, ARTIFACTS: self.artifacts}[name]


def job_id_of(root: str, path: str) -> str | None:
    parts = PurePosixPath(path).parts
    return parts[1] if root == ARTIFACTS and len(parts) > 2 and parts[0] == JOBS else None


def files_of(folders: Folders, database: Path | None) -> Iterator[StoredFile]:
    """All files, those that grow last: a training's journal may be ahead of its checkpoint, and not behind it.

    `database`: a SQLite file, which with its companions is copied otherwise.
    """
    found = list(_files(folders, database))
    yield from sorted(found, key=lambda file: (file.grows, file.root, file.path))


def _files(folders: Folders, database: Path | None) -> Iterator[StoredFile]:
    for name in SceneStore(folders.data).names():
        yield StoredFile(DATA, PurePosixPath(f"{name}{SUFFIX}"), folders.data / f"{name}{SUFFIX}")
    artifacts = folders.artifacts
    for name in SceneStore(artifacts / SCENES_FOLDER).names():
        path = PurePosixPath(SCENES_FOLDER, f"{name}{SUFFIX}")
        yield StoredFile(ARTIFACTS, path, artifacts / path)
    for folder in (FILES, MANIFESTS, JOBS):  # a dataset's files are there before its manifest
        kept = _below(artifacts, PurePosixPath(folder))
        yield from (file for file in kept if not any(map(_is_of_a_process, file.path.parts[1:])))
    for entry in _entries(artifacts):  # facts about the folder itself
        is_database = database is not None and entry.name.startswith(database.name)
        if entry.is_file() and not is_database and not _is_of_a_process(entry.name) and entry.name != MARKER:
            yield StoredFile(ARTIFACTS, PurePosixPath(entry.name), artifacts / entry.name)


def _below(root: Path, path: PurePosixPath) -> Iterator[StoredFile]:
    for entry in _entries(root / path):
        if entry.is_dir(follow_symlinks=False):
            yield from _below(root, path / entry.name)
        elif entry.is_file(follow_symlinks=False):
            yield StoredFile(ARTIFACTS, path / entry.name, root / path / entry.name)


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return list(entries)
    except (FileNotFoundError, NotADirectoryError):  # it went meanwhile
        return []


def _is_of_a_process(name: str) -> bool:
    return name.startswith(".") or name.endswith(_OF_A_PROCESS)
