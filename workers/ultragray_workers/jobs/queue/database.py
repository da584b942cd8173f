"""The database under the queue: where it is, and what both the store and the workers do with it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from dbos import DBOS, DBOSClient, DBOSPortableJSONSerializer, EnqueueOptions, WorkflowStatus
from sqlalchemy.engine import ExceptionContext
from sqlalchemy.exc import SQLAlchemyError

from ultragray_workers.errors import DatabaseUnavailable, StartupFailed, StorageFull
from ultragray_workers.jobs.matching.demand import Demand
from ultragray_workers.jobs.queue import runs, tables
from ultragray_workers.jobs.queue.folder_identity import FolderIdentity, FolderPlace, StoragePlace, identify
from ultragray_workers.jobs.queue.internals import (
    SCHEMA,
    SQLITE_ISOLATION,
    SQLITE_SETTINGS,
    WORKFLOWS,
    put_back,
    take_back,
)
from ultragray_workers.jobs.queue.writable import WriteProbe
from ultragray_workers.storage.storage import Storage
from ultragray_workers.store import PRIVATE_FILE, PRIVATE_FOLDER

APPLICATION = "ultragray"
# Of the workflow's inputs and steps: workers take the jobs of their own version only, and make jobs of older ones that
# they can do as well their own.
VERSION, OLDER_VERSIONS = "3", ("1", "2")
QUEUE = "ultragray-jobs"
SQLITE_FILE = "jobs.sqlite"
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
_DEADLOCK = "40P01"
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

QUEUED = ("ENQUEUED",)  # no job is delayed
RUNNING = ("PENDING",)
SUCCEEDED = ("SUCCESS",)
FAILED = ("ERROR", "MAX_RECOVERY_ATTEMPTS_EXCEEDED")
CANCELLED = ("CANCELLED",)

_REPORTED_BY_US = (
    "Exception encountered in background workflow",
    "no longer owned",  # by this worker
    "to verify existence of",  # the database, to which we have been connected
    "psycopg.OperationalError",  # the heartbeat logs once what these log several times a second
    "psycopg.errors.AdminShutdown",
    "psycopg.errors.CannotConnectNow",
    "psycopg.errors.ConnectionTimeout",
    "Notification listener error",
    "disk is full",
)

# Rows hold JSON, never pickles: whoever can write to the database must not run code in the service.
SERIALIZER = DBOSPortableJSONSerializer()


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


class JobDatabase:
    """A connection to the queue, its tables made where they are missing. Free for use from several threads."""

    def __init__(self, artifact_folder: Path, database_url: str | None, shared: Storage | None = None) -> None:
        """Raises StartupFailed where the database cannot be used.

        `shared`: the storage that belongs to the database; None: the artifact folder does.

        While a database that was there is away or read-only, every use that needs it raises DatabaseUnavailable;
        StorageFull where a SQLite file cannot grow.
        """
        quiet_dbos()
        try:
            with ExitStack() as undo:
                artifact_folder.mkdir(mode=PRIVATE_FOLDER, parents=True, exist_ok=True)
                self.url = checked_url(database_url, artifact_folder)
                engine = _engine(self.url)
                undo.callback(engine.dispose)
                if engine.dialect.name == "sqlite" and engine.url.database:
                    with suppress(FileExistsError):
                        Path(engine.url.database).touch(PRIVATE_FILE, exist_ok=False)  # its companions get its mode
                # Also for tables of our own beside those of the queue.
                self.engine = engine.execution_options(
                    schema_translate_map={SCHEMA: None if engine.dialect.name == "sqlite" else SCHEMA}
                )
                # The lock connects first: DBOS would make a PostgreSQL database that is not there, and a misspelt name
                # would be a queue of its own.
                with tables.one_at_a_time(engine.url):
                    tables.require_known_queue(self.engine)
                    DBOS.migrate(self.url)
                    tables.migrate(self.engine)
                    self.folder = self._identify(artifact_folder, shared)
                self._probe = WriteProbe(self.engine)
                self.client = DBOSClient(
                    system_database_engine=engine,
                    application_name=APPLICATION,
                    serializer=SERIALIZER,
                    retry_connection_errors=False,
                )
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
        sa.event.listen(engine, "handle_error", _raise_as_ours)

    def _identify(self, artifact_folder: Path, shared: Storage | None) -> FolderIdentity:
        if shared is not None:
            with self.engine.begin() as connection:
                return identify(connection, StoragePlace(shared), holds_database=False)
        holds_database = self.engine.url.database == str(artifact_folder.resolve() / SQLITE_FILE)
        with self.engine.begin() as connection:
            return identify(connection, FolderPlace(artifact_folder), holds_database=holds_database)

    def check(self) -> None:
        """Raises DatabaseUnavailable or StorageFull unless a row could be written now."""
        self._probe.check()

    def enqueue(
        self, options: EnqueueOptions, *arguments: Any, also: Callable[[sa.Connection], None] = lambda connection: None
    ) -> None:
        """Puts a workflow into the queue behind all others of its priority, and does `also` in the same transaction.

        The specification among its attributes says what it asks of a worker.

        DBOS orders by the time of submission, which on SQLite it may know to the second only: here it is set to the
        millisecond, and after that of every other job.
        """
        while True:
            try:
                return self._enqueue(also, options, *arguments)
            except SQLAlchemyError as error:
                # Two submissions of one job at once: PostgreSQL ends one of them, which then finds the other's.
                if getattr(getattr(error, "orig", None), "sqlstate", None) != _DEADLOCK:
                    raise

    def _enqueue(self, also: Callable[[sa.Connection], None], options: EnqueueOptions, *arguments: Any) -> None:
        rows = WORKFLOWS
        with self.engine.begin() as connection:
            self.client.enqueue_in_transaction(connection, options, *arguments)
            runs.begin(connection, options["workflow_id"])
            last_ms = sa.select(sa.func.coalesce(sa.func.max(rows.c.created_at), 0)).where(
                rows.c.workflow_uuid != options["workflow_id"]
            )
            submitted_ms = max(int(time.time() * 1000), 1 + (connection.execute(last_ms).scalar() or 0))
            demand = Demand.of(options["attributes"]["specification"])
            connection.execute(
                sa.update(rows)
                .where(rows.c.workflow_uuid == options["workflow_id"])
                .values(created_at=submitted_ms, queue_partition_key=demand.key)
            )
            also(connection)

    def workflow(self, job_id: str, *, with_input: bool = False, with_output: bool = False) -> WorkflowStatus | None:
        """The queue's row of a job; None where there is no such job."""
        rows = self.client.list_workflows(workflow_ids=[job_id], load_input=with_input, load_output=with_output)
        return rows[0] if rows else None

    def put_back(self, job_id: str, executor: str) -> bool:
        """Puts a job that `executor` runs back into the queue; False where it does not run it (any more)."""
        return put_back(self.client, job_id, executor, QUEUE)

    def take_back(self, job_id: str, executor: str) -> bool:
        """As `put_back`, of a job that was taken and not begun."""
        return take_back(self.engine, self.client, job_id, executor, QUEUE)

    def close(self) -> None:
        """Ends the connections."""
        self.client.destroy()
        self.engine.dispose()


def _engine(url: str) -> sa.Engine:
    """An engine like the one that DBOS makes of a URL."""
    engine = sa.create_engine(url, pool_size=_CONNECTIONS, max_overflow=0, pool_timeout=30, pool_pre_ping=True)
    if engine.dialect.name == "sqlite":

        @sa.event.listens_for(engine, "connect")
        def configure(connection: Any, record: Any) -> None:
            connection.isolation_level = SQLITE_ISOLATION
            for name, value in SQLITE_SETTINGS.items():
                connection.execute(f"PRAGMA {name}={value}")

    return engine


def quiet_dbos() -> None:
    """Lets DBOS log its warnings, and nothing else, through the handlers of the process."""
    logger = logging.getLogger("dbos")
    logger.handlers.clear()
    logger.propagate = True
    logger.setLevel(logging.WARNING)
    logger.addFilter(_is_news)


def _is_news(record: logging.LogRecord) -> bool:
    """Keeps out what is ordinary or logged by us: ends of jobs, and a database that is away."""
    message = record.getMessage()
    return not any(known in message for known in _REPORTED_BY_US)


def dbos_config(url: str, executor: str) -> Any:
    """The configuration of a worker's DBOS: pinned version, stable executor, no ports, no telemetry."""
    return {
        "name": APPLICATION,
        "system_database_url": url,
        "application_version": VERSION,
        "executor_id": executor,
        "serializer": SERIALIZER,
        "log_level": "WARNING",
        "enable_otlp": False,
        "run_migrations": False,
    }
