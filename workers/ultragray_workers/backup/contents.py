"""The files that belong to a backup: scenes, datasets and jobs, without locks, caches and half made things."""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ultragray.files import file_sha256, sync
from ultragray_workers.datasets.recording import BLOCKS, RECORDINGS
from ultragray_workers.datasets.store import FILES, MANIFESTS
from ultragray_workers.jobs.files import FOLDER as JOBS
from ultragray_workers.scene_names import SUFFIXES
from ultragray_workers.scene_shelf import SCENES_FOLDER
from ultragray_workers.scenes import SceneStore
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
    files = list(_files(folders, database))
    yield from sorted(files, key=lambda file: (file.grows, file.root, file.path))


def _files(folders: Folders, database: Path | None) -> Iterator[StoredFile]:
    artifacts = folders.artifacts
    for root, below in ((DATA, PurePosixPath()), (ARTIFACTS, PurePosixPath(SCENES_FOLDER))):
        scenes = folders.root(root) / below
        names = [f"{name}{suffix}" for name in SceneStore(scenes).names() for suffix in SUFFIXES]
        yield from (StoredFile(root, below / name, scenes / name) for name in names if (scenes / name).is_file())
    # The files of a dataset are there before its manifest, and a recording is there before its blocks.
    for folder in (RECORDINGS, BLOCKS, FILES, MANIFESTS, JOBS):
        files = _below(artifacts, PurePosixPath(folder))
        yield from (file for file in files if not any(map(_is_of_a_process, file.path.parts[1:])))
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


FOLDER = "objects"
_INCOMING = ".incoming-"
_NAME = re.compile(r"[0-9a-f]{64}")
_BLOCK_BYTES = 2**20
_ATTEMPTS = 5  # to read a file that somebody rewrites in its place


@dataclass(frozen=True)
class Stored:
    sha256: str
    bytes: int
    version: FileVersion
    is_new: bool  # no earlier file had this content


class Objects:
    """The contents in a backup folder. One process at a time adds and removes them."""

    def __init__(self, backup_folder: Path) -> None:
        self.folder = backup_folder / FOLDER

    def path(self, sha256: str) -> Path:
        """The place of a content, also of one that is not there."""
        return self.folder / sha256[:2] / sha256

    def has(self, sha256: str) -> bool:
        return self.path(sha256).is_file()

    def is_whole(self, sha256: str) -> bool:
        return self.has(sha256) and file_sha256(self.path(sha256)) == sha256

    def add(self, source: Path, *, grows: bool = False) -> Stored:
        """Keeps a copy of a file; one that `grows` is taken up to the length that it has at first. Raises OSError.

        A file that is replaced meanwhile is kept as it was at first, one that is rewritten in its place is read again.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        for _ in range(_ATTEMPTS):
            with source.open("rb") as file:
                before = FileVersion.of(file.fileno())
                descriptor, name = tempfile.mkstemp(dir=self.folder, prefix=_INCOMING)
                incoming = Path(name)
                try:
                    digest = hashlib.sha256()
                    rest_bytes = before.size
                    with os.fdopen(descriptor, "wb") as copy:
                        while rest_bytes and (block := file.read(min(_BLOCK_BYTES, rest_bytes))):
                            digest.update(block)
                            copy.write(block)
                            rest_bytes -= len(block)
                    if not rest_bytes and (grows or FileVersion.of(file.fileno()) == before):
                        return self._keep(incoming, digest.hexdigest(), before)
                finally:
                    incoming.unlink(missing_ok=True)
        raise OSError(f"{source} changes all the time: it could not be copied as it was at one moment")

    def _keep(self, incoming: Path, sha256: str, version: FileVersion) -> Stored:
        target = self.path(sha256)
        is_new = not target.is_file()
        if is_new:
            target.parent.mkdir(exist_ok=True)
            sync(incoming)
            incoming.rename(target)
            sync(target.parent)
        return Stored(sha256, version.size, version, is_new)

    def remove_all_but(self, kept: set[str]) -> tuple[int, int]:
        """Removes the contents that no backup has any more, and half written ones; their number and bytes."""
        count = size = 0
        for path in self._files():
            if path.name not in kept:
                count, size = count + 1, size + path.stat().st_size
                path.unlink()
        return count, size

    def remove_leftovers(self) -> None:
        for path in self.folder.glob(f"{_INCOMING}*"):
            path.unlink()

    def _files(self) -> Iterator[Path]:
        for path in self.folder.glob("??/*"):
            if _NAME.fullmatch(path.name):
                yield path
