"""The artifact folder of a queue, known by an id that the folder and the database both hold.

Without its share mounted, a folder is an empty one of the same name: a worker in it would fail every job, and a service
would find none of the files that its jobs made.
"""

from __future__ import annotations

import os
import tempfile
import uuid
from pathlib import Path

import sqlalchemy as sa

from ultragray.files.atomic import write_whole

from ...errors import ArtifactFolderUnavailable, StartupFailed
from .tables import FOLDER

FILE = "folder_id"  # of the artifact folder


class FolderIdentity:
    """The id that the artifact folder must have."""

    def __init__(self, artifact_folder: Path, known: str) -> None:
        self._folder, self._path, self._known = artifact_folder, artifact_folder / FILE, known

    def check(self) -> None:
        """Raises ArtifactFolderUnavailable where the folder is gone or is another one now."""
        if _read(self._path) != self._known:
            raise ArtifactFolderUnavailable(
                "the artifact folder is not the one that the jobs belong to: its share may not be mounted"
            )

    def check_writable(self) -> None:
        """As `check`, and raises ArtifactFolderUnavailable where no file can be made in the folder."""
        self.check()
        try:
            tempfile.TemporaryFile(dir=self._folder).close()
        except OSError as error:
            reason = os.strerror(error.errno) if error.errno else "no reason was given"
            raise ArtifactFolderUnavailable(f"the artifact folder takes no files: {reason}") from error


def identify(connection: sa.Connection, artifact_folder: Path, *, holds_database: bool) -> FolderIdentity:
    """The identity of the folder: a database without one takes the folder's, or gives it a new one.

    `holds_database`: the database is a file in the folder, which then cannot be another one. The caller holds the lock
    of the tables. Raises StartupFailed where the database belongs to another folder, OSError.
    """
    path = artifact_folder / FILE
    known, there = connection.execute(sa.select(FOLDER.c.id)).scalar(), _read(path)
    expected = known or there or uuid.uuid4().hex
    if there is None and (known is None or holds_database):
        write_whole(path, f"{expected}\n")
    elif there != expected:
        raise StartupFailed(
            f"artifact_folder {str(artifact_folder)!r} is not the one that the database of the jobs belongs to: its "
            f"file {FILE} holds {there or 'no id'}, expected {expected}. Mount the share that belongs there; only "
            "where the folder was replaced on purpose, write the expected id into that file",
            field="artifact_folder",
        )
    if known is None:
        connection.execute(sa.insert(FOLDER).values(id=expected))
    return FolderIdentity(artifact_folder, expected)


def _read(path: Path) -> str | None:
    try:
        return path.read_text(encoding="ascii").strip() or None
    except (OSError, ValueError):
        return None
