"""The identity of the storage of a database: an id that the storage and the database both hold.

Without its share mounted, a folder is an empty one of the same name: a worker in it would fail every job, and a service
would find none of the files that its jobs made. Likewise with a storage whose URL names another bucket or prefix.
"""

from __future__ import annotations

import threading
import time
import uuid

import sqlalchemy as sa

from ultragray.errors import UltragrayError
from ultragray_workers.errors import ArtifactFolderUnavailable, StartupFailed
from ultragray_workers.jobs.tables import STORE
from ultragray_workers.storage.storage import NotThere, Storage

KEY = "folder_id"
_PROBES = "probes"  # prefix of objects that are written and removed again


class StoreIdentity:
    def __init__(self, storage: Storage, known: str) -> None:
        self._storage, self._known = storage, known
        self._checking = threading.Lock()
        self._right_at_s = float("-inf")

    def check(self, max_age_s: float = 0.0) -> None:
        """Raises ArtifactFolderUnavailable where the storage is away, or is another one now.

        `max_age_s`: how old a good answer may be.
        """
        with self._checking:
            if time.monotonic() - self._right_at_s < max_age_s:
                return
            self._right_at_s = float("-inf")
            if _read(self._storage) != self._known:
                raise ArtifactFolderUnavailable(
                    "the artifact folder is not the one that the jobs belong to: its share may not be mounted, or its "
                    "URL may name another bucket or prefix"
                )
            self._right_at_s = time.monotonic()

    def check_writable(self) -> None:
        """As `check`, and raises ArtifactFolderUnavailable where nothing can be written."""
        self.check()
        key = f"{_PROBES}/{uuid.uuid4().hex}"
        try:
            self._storage.write(key, b"")
            self._storage.delete(key)
        except UltragrayError as error:
            raise ArtifactFolderUnavailable(error.detail) from None
        except OSError as error:
            reason = error.strerror or "no reason was given"
            raise ArtifactFolderUnavailable(f"the artifact folder takes no files: {reason}") from error


def identify(connection: sa.Connection, storage: Storage, *, holds_database: bool) -> StoreIdentity:
    """The identity of a storage: a database without one takes the storage's, or gives it a new one.

    `holds_database`: the database is a file in the storage, which then cannot be another one. The caller holds the lock
    of the tables. Raises StartupFailed where the database belongs to another storage, OSError.
    """
    known = connection.execute(sa.select(STORE.c.id)).scalar()
    try:
        there = _read(storage)
    except ArtifactFolderUnavailable as error:
        raise StartupFailed(error.detail, field="artifact_folder") from error
    expected = known or there or uuid.uuid4().hex
    if there is None and (known is None or holds_database):
        if not storage.write(KEY, f"{expected}\n".encode(), if_absent=True):
            raise StartupFailed(
                f"{storage.location} belongs to another database since a moment ago", field="artifact_folder"
            )
    elif there != expected:
        raise StartupFailed(
            f"artifact_folder {storage.location!r} is not the one that the database of the jobs belongs to: its "
            f"file {KEY} holds {there or 'no id'}, expected {expected}. Mount the share that belongs there; only "
            "where the folder was replaced on purpose, write the expected id into that file",
            field="artifact_folder",
        )
    if known is None:
        connection.execute(sa.insert(STORE).values(id=expected))
    return StoreIdentity(storage, expected)


def _read(storage: Storage) -> str | None:
    """The id of a storage; None where it has none. Raises ArtifactFolderUnavailable."""
    try:
        return storage.read(KEY).decode("ascii", "replace").strip() or None
    except (NotThere, OSError):
        return None
    except UltragrayError as error:
        raise ArtifactFolderUnavailable(error.detail) from None
