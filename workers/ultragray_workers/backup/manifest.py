"""The list of one backup: what it holds, by which hashes, and who made it. A backup is there once its list is.

manifests/20261122T070301.123Z.json      {"format_version": 1, "sha256": of the rest, …}
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

from ultragray.files import write_whole
from ultragray_workers.errors import BackupInvalid

FORMAT_VERSION = 1
FOLDER = "manifests"
ROOTS = ("data", "artifacts")
_NAME = re.compile(r"[0-9]{8}T[0-9]{6}\.[0-9]{3}Z")
_HASH = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class FileEntry:
    """A file of the data folder or the artifact folder."""

    root: str  # of ROOTS
    path: str  # below it
    sha256: str
    bytes: int
    mtime_ns: int
    version: str  # tells without reading whether the file that was copied is still the same


@dataclass(frozen=True)
class TableEntry:
    """The rows of a table, as PostgreSQL's COPY writes them."""

    name: str
    columns: tuple[str, ...]
    rows: int
    sha256: str
    bytes: int


@dataclass(frozen=True)
class DatabaseEntry:
    """The database at one moment: a SQLite file, or the rows of PostgreSQL's tables."""

    kind: str  # sqlite or postgresql
    tables_version: int
    jobs: dict[str, int]  # how many, by their state
    sha256: str | None = None  # of the SQLite file
    bytes: int = 0
    tables: tuple[TableEntry, ...] = ()


@dataclass(frozen=True)
class Manifest:
    name: str  # the time at which it began, UTC
    release: str
    files: tuple[FileEntry, ...]
    database: DatabaseEntry | None  # None: nothing has ever been submitted
    # What became of jobs between the copies of the database and of the files: a restore does the same to them.
    deleted_jobs: tuple[str, ...] = ()
    cancelled_jobs: tuple[str, ...] = ()
    counts: dict[str, int] = field(default_factory=dict)  # scenes, datasets, jobs, unfinished jobs

    @property
    def bytes(self) -> int:
        """The size of all that it holds, files of the same content counted each."""
        return sum(entry.bytes for entry in self.files) + sum(self._database_objects().values())

    def objects(self) -> dict[str, int]:
        """The contents that it needs, and their sizes."""
        return {entry.sha256: entry.bytes for entry in self.files} | self._database_objects()

    def _database_objects(self) -> dict[str, int]:
        if self.database is None:
            return {}
        objects = {table.sha256: table.bytes for table in self.database.tables}
        return objects if self.database.sha256 is None else {**objects, self.database.sha256: self.database.bytes}


def names(backup_folder: Path) -> list[str]:
    """The backups of a folder, oldest first."""
    return sorted(path.stem for path in (backup_folder / FOLDER).glob("*.json") if _NAME.fullmatch(path.stem))


def write(backup_folder: Path, manifest: Manifest) -> None:
    """Makes the backup one of the folder. Raises OSError."""
    document = {"format_version": FORMAT_VERSION, **asdict(manifest)}
    path = _path(backup_folder, manifest.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps({**document, "sha256": _sha256(document)}) + "\n")


def remove(backup_folder: Path, name: str) -> None:
    """The backup is none of the folder any more; its contents stay. Raises OSError."""
    _path(backup_folder, name).unlink()


def read(backup_folder: Path, name: str | None) -> Manifest:
    """A backup of a folder, or the newest. Raises BackupInvalid where there is none, or where it cannot be used."""
    backups = names(backup_folder)
    if not backups:
        raise BackupInvalid(f"{backup_folder} holds no backup")
    if name is not None and name not in backups:
        raise BackupInvalid(f"{backup_folder} holds no backup {name!r}, it holds {', '.join(backups)}")
    path = _path(backup_folder, name or backups[-1])
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        digest, version = document.pop("sha256"), document["format_version"]
        if version != FORMAT_VERSION:
            raise BackupInvalid(
                f"{path} has version {version} of the format of backups, and this release reads version "
                f"{FORMAT_VERSION}: restore it with release {document['release']}"
            )
        if digest != _sha256(document):
            raise ValueError("it does not have its own hash")
        if document["name"] != path.stem:
            raise ValueError(f"it calls itself {document['name']!r}")
        return _manifest_of(document)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise BackupInvalid(f"{path} is damaged: {error}") from error


def _manifest_of(document: dict[str, Any]) -> Manifest:
    values = {name: value for name, value in document.items() if name != "format_version"}
    database = values["database"]
    if database is not None:
        tables = tuple(TableEntry(**{**one, "columns": tuple(one["columns"])}) for one in database["tables"])
        values["database"] = DatabaseEntry(**{**database, "tables": tables})
    values["files"] = files = tuple(map(_file_entry, values["files"]))
    paths = {(entry.root, PurePosixPath(entry.path)) for entry in files}
    for root, path in paths:
        if any((root, parent) in paths for parent in path.parents):
            raise ValueError(f"it names the file {root} {str(path)!r} below another file")
    manifest = Manifest(**values)
    return replace(manifest, deleted_jobs=tuple(manifest.deleted_jobs), cancelled_jobs=tuple(manifest.cancelled_jobs))


def _file_entry(document: dict[str, Any]) -> FileEntry:
    entry = FileEntry(**document)
    path = PurePosixPath(entry.path)
    if entry.root not in ROOTS or path.is_absolute() or ".." in path.parts or not path.parts or "\0" in entry.path:
        raise ValueError(f"it names the file {entry.root} {entry.path!r}")
    if not _HASH.fullmatch(entry.sha256):
        raise ValueError(f"it names the hash {entry.sha256!r}")
    return entry


def _path(backup_folder: Path, name: str) -> Path:
    return backup_folder / FOLDER / f"{name}.json"


def _sha256(document: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
