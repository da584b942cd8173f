"""The artifact folder of a queue, known by an id that the folder and the database both hold.

Without its share mounted, a folder is an empty one of the same name: a worker in it would fail every job, and a service
would find none of the files that its jobs made. Likewise with a storage whose URL names another bucket or prefix.
"""

from __future__ import annotations

import os
import tempfile
import threading
import time
import uuid
from pathlib import Path
from typing import Protocol

import sqlalchemy as sa

from ultragray.errors import UltragrayError
from ultragray.files import write_whole
from ultragray_workers.errors import ArtifactFolderUnavailable, StartupFailed
from ultragray_workers.jobs.queue.tables import FOLDER
from ultragray_workers.storage.storage import NotThere, Storage

FILE = "folder_id"  # of the artifact folder, or the key of an object
_PROBES = "probes"  # prefix of objects that are written and removed again
_ASKED_EVERY_S = 5.0  # of a storage: workers check several times a second


class FolderIdentity:
    """The id that the artifact folder must have."""

    def __init__(self, folder: Place, known: str) -> None:
        self._folder, self._known = folder, known

    def check(self) -> None:
        """Raises ArtifactFolderUnavailable where the folder is gone or is another one now."""
        if self._folder.read() != self._known:
            raise ArtifactFolderUnavailable(
                f"{self._folder.name} is not the one that the jobs belong to{self._folder.hint}"
            )

    def check_writable(self) -> None:
        """As `check`, and raises ArtifactFolderUnavailable where no file can be made in the folder."""
        self.check()
        self._folder.probe()


class Place(Protocol):
    """Where an id is kept: a folder or a storage."""

    name: str  # in errors
    hint: str

    def read(self) -> str | None:
        """The id; None where there is none. Raises ArtifactFolderUnavailable."""

    def write(self, identity: str) -> None:
        """Gives the place an id, where it has none. Raises StartupFailed, OSError."""

    def probe(self) -> None:
        """Makes a file and removes it. Raises ArtifactFolderUnavailable."""


class FolderPlace:
    """An artifact folder."""

    name, hint = "the artifact folder", ": its share may not be mounted"

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __str__(self) -> str:
        return str(self._folder)

    def read(self) -> str | None:
        """As `Place`."""
        try:
            return (self._folder / FILE).read_text(encoding="ascii").strip() or None
        except (OSError, ValueError):
            return None

    def write(self, identity: str) -> None:
        """As `Place`."""
        write_whole(self._folder / FILE, f"{identity}\n")

    def probe(self) -> None:
        """As `Place`."""
        try:
            tempfile.TemporaryFile(dir=self._folder).close()
        except OSError as error:
            reason = os.strerror(error.errno) if error.errno else "no reason was given"
            raise ArtifactFolderUnavailable(f"the artifact folder takes no files: {reason}") from error


class StoragePlace:
    """A storage that hosts share, asked for its id now and then."""

    name, hint = "the object storage of the artifacts", ": its URL may name another bucket or prefix"

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._asking = threading.Lock()
        self._asked_at_s = float("-inf")
        self._answer: str | ArtifactFolderUnavailable | None = None

    def __str__(self) -> str:
        return self._storage.location

    def read(self) -> str | None:
        """As `Place`."""
        with self._asking:
            if time.monotonic() - self._asked_at_s > _ASKED_EVERY_S:
                self._answer = self._ask()
                self._asked_at_s = time.monotonic()
            if isinstance(self._answer, ArtifactFolderUnavailable):
                raise self._answer.with_traceback(None)
            return self._answer

    def write(self, identity: str) -> None:
        """As `Place`."""
        if not self._storage.write(FILE, f"{identity}\n".encode(), if_absent=True):
            raise StartupFailed(f"{self} belongs to another database since a moment ago", field="artifact_folder")
        with self._asking:
            self._answer = identity

    def probe(self) -> None:
        """As `Place`."""
        key = f"{_PROBES}/{uuid.uuid4().hex}"
        try:
            self._storage.write(key, b"")
            self._storage.delete(key)
        except UltragrayError as error:
            raise ArtifactFolderUnavailable(error.detail) from None

    def _ask(self) -> str | ArtifactFolderUnavailable | None:
        try:
            return self._storage.read(FILE).decode("ascii", "replace").strip() or None
        except NotThere:
            return None
        except UltragrayError as error:
            return ArtifactFolderUnavailable(error.detail)


def identify(connection: sa.Connection, place: Place, *, holds_database: bool) -> FolderIdentity:
    """The identity of the place: a database without one takes the place's, or gives it a new one.

    `holds_database`: the database is a file in the folder, which then cannot be another one. The caller holds the lock
    of the tables. Raises StartupFailed where the database belongs to another folder, OSError.
    """
    known = connection.execute(sa.select(FOLDER.c.id)).scalar()
    try:
        there = place.read()
    except ArtifactFolderUnavailable as error:
        raise StartupFailed(error.detail, field="artifact_folder") from error
    expected = known or there or uuid.uuid4().hex
    if there is None and (known is None or holds_database):
        place.write(expected)
    elif there != expected:
        raise StartupFailed(
            f"artifact_folder {str(place)!r} is not the one that the database of the jobs belongs to: its "
            f"file {FILE} holds {there or 'no id'}, expected {expected}. Mount the share that belongs there; only "
            "where the folder was replaced on purpose, write the expected id into that file",
            field="artifact_folder",
        )
    if known is None:
        connection.execute(sa.insert(FOLDER).values(id=expected))
    return FolderIdentity(place, expected)
