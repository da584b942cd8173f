"""The database of the jobs: a SQLite file in the artifact folder, or PostgreSQL, by one URL.

`jobs.store` and the workers share it; the service's keys, owners, audit and registrations use its engine, too. While a
database that was there is away or read-only, every use that needs it raises DatabaseUnavailable. Free of torch.
"""

from __future__ import annotations

import os
import threading
import time
import uuid
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import ExceptionContext
from sqlalchemy.exc import SQLAlchemyError

from ultragray.errors import UltragrayError
from ultragray_workers.errors import ArtifactFolderUnavailable, DatabaseUnavailable, StartupFailed, StorageFull
from ultragray_workers.jobs import tables
from ultragray_workers.jobs.tables import SCHEMA, STORE, WORKERS
from ultragray_workers.storage.local import LocalStorage
from ultragray_workers.storage.storage import NotThere, Storage
from ultragray_workers.store import PRIVATE_FILE, PRIVATE_FOLDER

SQLITE_FILE = "jobs.sqlite"
_SQLITE_SETTINGS = {"busy_timeout": 30_000, "foreign_keys": 1}
_POSTGRES_SCHEMES = ("postgresql", "postgres", "postgresql+psycopg")
# libpq's: a server that cannot be reached, or from which nothing comes back any more, is given up. s, ms, ms, ms
_PATIENCE = {
    "connect_timeout": "5",
    "tcp_user_timeout": "10000",
    "options": "-c statement_timeout=30000 -c idle_in_transaction_session_timeout=60000",
}
_CONNECTIONS = 5
# SQLSTATE: the connection is gone, the server lacks the means, a statement took too long, the server stops or starts.
_AWAY = ("08", "53", "57014", "57P")
_TAKES_NO_CHANGES = "the database of the jobs takes no changes: it is read-only"
_IS_LOST = "the database of the jobs is not there any more, or has lost its tables"
_REFUSALS = {  # by SQLSTATE, or by words of SQLite
    "25006": _TAKES_NO_CHANGES,
    "readonly database": _TAKES_NO_CHANGES,
    "42P01": _IS_LOST,
    "no such table": _IS_LOST,
    "unable to open database file": _IS_LOST,
    "disk I/O error": "the disk of the jobs' database fails",
}


class JobDatabase:
    """A connection to the database, its tables made where they are missing. Free for use from several threads."""

    def __init__(self, artifact_folder: Path, database_url: str | None, storage: Storage | None = None) -> None:
        """`storage`: of the files of the jobs, which belongs to the database; None: the artifact folder.

        Raises StartupFailed where the database cannot be used.
        """
        storage = storage or LocalStorage(artifact_folder)
        try:
            with ExitStack() as undo:
                artifact_folder.mkdir(mode=PRIVATE_FOLDER, parents=True, exist_ok=True)
                self.url = checked_url(database_url, artifact_folder)
                engine = _engine(self.url)
                undo.callback(engine.dispose)
                self._file = engine.url.database if engine.dialect.name == "sqlite" else None
                if self._file:
                    with suppress(FileExistsError):
                        Path(self._file).touch(PRIVATE_FILE, exist_ok=False)  # its companions get its mode
                self.engine = engine.execution_options(
                    schema_translate_map={SCHEMA: None if engine.dialect.name == "sqlite" else SCHEMA}
                )
                with tables.one_at_a_time(engine.url):
                    tables.make_tables(self.engine)
                    holds_database = self._file == str(artifact_folder.resolve() / SQLITE_FILE)
                    with self.engine.begin() as connection:
                        self.identity: StoreIdentity = identify(connection, storage, holds_database=holds_database)
                undo.pop_all()
        except (SQLAlchemyError, OSError) as error:
            cause = getattr(error, "orig", None) or error
            if isinstance(cause, OSError) and cause.strerror:
                cause = f"{cause.filename}: {cause.strerror.lower()}"
            raise StartupFailed(
                f"the database of the jobs cannot be opened: {' '.join(str(cause).split())} "
                "(ULTRAGRAY_DATABASE_URL names it: server and database must be there, user and password right)",
                field="database_url",
            ) from error
        self._opened = _inode(self._file) if self._file else None
        if self._file:
            # SQLite calls a file that was moved read-only, and makes an empty one in place of one that was removed.
            for event in ("handle_error", "do_connect"):
                sa.event.listen(engine, event, lambda *_: self._require_same_file())
        sa.event.listen(engine, "handle_error", _raise_as_ours)

    def check(self) -> None:
        """Raises DatabaseUnavailable or StorageFull unless a row could be written now: one is written and taken back.

        To read would not tell: a SQLite file that was removed is read to the end of the process, a full or read-only
        disk shows with the first page, and a standby of PostgreSQL answers every question.
        """
        self._require_same_file()
        try:
            with self.engine.connect() as connection:  # whose end takes the row back
                connection.execute(sa.insert(WORKERS).values(name=f"check {uuid.uuid4().hex}", seen_at_s=0.0))
        except SQLAlchemyError as error:
            raise DatabaseUnavailable("the database of the jobs refuses to write") from error

    def close(self) -> None:
        self.engine.dispose()

    def _require_same_file(self) -> None:
        if self._file and _inode(self._file) != self._opened:
            raise DatabaseUnavailable(
                "the file of the jobs' database was removed or replaced while it was in use: put it back, or start the "
                "service again"
            )


def checked_url(database_url: str | None, artifact_folder: Path) -> str:
    """The URL given, which gives up on a silent server in time; None: that of a SQLite file in the artifact folder.

    Raises StartupFailed for one that names no database.
    """
    if database_url is None:
        return f"sqlite:///{artifact_folder.resolve() / SQLITE_FILE}"
    try:
        url = sa.make_url(database_url)
    except (SQLAlchemyError, ValueError):
        url = sa.URL.create("unreadable")
    if url.drivername == "sqlite" and url.database:
        return database_url
    is_split_rightly = "@" not in f"{url.host}{url.database}"  # else a part of the password
    if url.drivername not in _POSTGRES_SCHEMES or not url.database or not is_split_rightly:
        raise StartupFailed(  # without the URL: it may hold a password
            "database_url must be postgresql://USER:PASSWORD@HOST:PORT/DATABASE (in the password, %40 stands for @, "
            "%2F for /), or be left out for a SQLite file in the artifact folder",
            field="database_url",
        )
    ours = url.set(drivername="postgresql+psycopg", query={**_PATIENCE, **url.query})
    return ours.render_as_string(hide_password=False)


def _engine(url: str) -> sa.Engine:
    engine = sa.create_engine(url, pool_size=_CONNECTIONS, max_overflow=0, pool_timeout=30, pool_pre_ping=True)
    if engine.dialect.name == "sqlite":

        @sa.event.listens_for(engine, "connect")
        def configure(connection: Any, record: Any) -> None:
            connection.isolation_level = "IMMEDIATE"  # a change locks the file from its start; a question does not
            for name, value in _SQLITE_SETTINGS.items():
                connection.execute(f"PRAGMA {name}={value}")

    return engine


def _raise_as_ours(context: ExceptionContext) -> None:
    if context.is_pre_ping:  # a connection that was lost while nobody used it is replaced
        return
    error = context.original_exception
    if "disk is full" in str(error):
        raise StorageFull("the disk of the jobs' database has no room") from error
    state = getattr(error, "sqlstate", None) or ""
    if context.connection is None or context.is_disconnect or state.startswith(_AWAY):
        raise DatabaseUnavailable("the database of the jobs does not answer: try again in a few seconds") from error
    for sign, meaning in _REFUSALS.items():
        if sign == state or (not state and sign in str(error)):
            raise DatabaseUnavailable(meaning) from error


def _inode(file: str) -> tuple[int, int] | None:
    """Device and inode of the file at a path; None: there is none."""
    try:
        status = os.stat(file)
    except OSError:
        return None
    return status.st_dev, status.st_ino


KEY = "folder_id"
_PROBES = "probes"  # prefix of objects that are written and removed again


class StoreIdentity:
    """The id that a storage must have, which its database holds, too.

    Without its share mounted, a folder is an empty one of the same name: a worker in it would fail every job, and a
    service would find none of the files that its jobs made. Likewise with a URL that names another bucket or prefix.
    """

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
        """Checks the identity, too. Raises ArtifactFolderUnavailable where nothing can be written."""
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
