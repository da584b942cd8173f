"""A copy of the database at one moment, and a database made of a copy: a SQLite file, or the rows of PostgreSQL.

PostgreSQL's rows are read by one transaction that sees one moment, with COPY, which every version of the server reads
and which needs no program beside the service: pg_dump must be as new as the server.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import psycopg
import sqlalchemy as sa
from psycopg import sql

from ultragray_workers.backup.contents import Objects
from ultragray_workers.backup.manifest import DatabaseEntry, TableEntry
from ultragray_workers.errors import BackupInvalid, RestoreRefused
from ultragray_workers.jobs import queue, tables
from ultragray_workers.jobs.database import checked_url
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.tables import JOBS, SCHEMA, SCHEMA_VERSION, TABLES, WORKERS

_SQLITE_WAIT_S = 60.0
_COPIED = [table for table in TABLES.sorted_tables if table not in (SCHEMA_VERSION, WORKERS)]
_BLOCK_BYTES = 2**20


@dataclass(frozen=True)
class Snapshot:
    entry: DatabaseEntry
    states: Mapping[str, JobState]  # of all jobs


class Database:
    """The database of an installation, whose tables are not made by opening it."""

    def __init__(self, artifact_folder: Path, database_url: str | None) -> None:
        """Raises StartupFailed for a URL that names no database."""
        self.url = sa.make_url(checked_url(database_url, artifact_folder))
        self.sqlite = Path(self.url.database or "") if self.url.get_backend_name() == "sqlite" else None

    @property
    def kind(self) -> str:
        return self.url.get_backend_name()

    def snapshot(self, objects: Objects, work_folder: Path) -> Snapshot | None:
        """A copy among the objects; None where there is no database. Raises OSError, and what its driver raises."""
        if self.sqlite is None:
            return self._postgresql_snapshot(objects, work_folder)
        if not self.sqlite.is_file():
            return None
        copy = work_folder / "database.sqlite"
        copy.unlink(missing_ok=True)
        with (
            closing(
                sqlite3.connect(f"file:{quote(str(self.sqlite))}?mode=ro", uri=True, timeout=_SQLITE_WAIT_S)
            ) as source,
            closing(sqlite3.connect(copy)) as target,
        ):
            source.backup(target)  # in one step, so that nobody writes in between
        stored = objects.add(copy)
        with _connected(sa.URL.create("sqlite", database=str(copy))) as connection:
            states = _states(connection)
            entry = DatabaseEntry(
                "sqlite", tables.version(connection) or 0, _counted(states), stored.sha256, stored.version.size
            )
        return Snapshot(entry, states)

    def states(self) -> Mapping[str, JobState]:
        if self.sqlite is not None and not self.sqlite.is_file():
            return {}
        with _connected(self.url) as connection:
            return _states(connection)

    def _postgresql_snapshot(self, objects: Objects, work_folder: Path) -> Snapshot | None:
        with _connected(self.url, is_patient=True, at_one_moment=True) as connection:
            if not sa.inspect(connection).has_table(JOBS.name, schema=SCHEMA):
                return None
            entries = []
            for table in _COPIED:
                columns = tuple(column.name for column in table.columns)
                copy = work_folder / "table"
                rows = _copy_out(connection, table, columns, copy)
                stored = objects.add(copy)
                entries.append(TableEntry(table.name, columns, rows, stored.sha256, stored.version.size))
            states = _states(connection)
            version = tables.version(connection) or 0
            entry = DatabaseEntry("postgresql", version, _counted(states), tables=tuple(entries))
        return Snapshot(entry, states)

    def holds_jobs(self) -> bool:
        """Whether a restore would replace something."""
        if self.sqlite is not None:
            return self.sqlite.exists()
        with _connected(self.url) as connection:
            return sa.inspect(connection).has_table(JOBS.name, schema=SCHEMA) and bool(_states(connection))

    def workers_at_work(self) -> list[str]:
        """The workers that have told a moment ago that they are alive."""
        if self.sqlite is not None:  # they have the artifact folder open
            return []
        with _connected(self.url) as connection:
            if not sa.inspect(connection).has_table(WORKERS.name, schema=SCHEMA):
                return []
            age_s = queue.now_s(connection.engine) - WORKERS.c.seen_at_s
            return list(connection.execute(sa.select(WORKERS.c.name).where(age_s < queue.DEAD_AFTER_S)).scalars())

    def check_loadable(self, entry: DatabaseEntry) -> None:
        """Raises RestoreRefused for a copy of another kind of database, BackupInvalid for one of another release."""
        if entry.kind != self.kind:
            raise RestoreRefused(
                f"the backup holds a database of the kind {entry.kind}, and the settings name one of the kind "
                f"{self.kind} (ULTRAGRAY_DATABASE_URL)",
                field="database_url",
            )
        if entry.tables_version != tables.VERSION:
            raise BackupInvalid(
                f"the backup holds tables of version {entry.tables_version}, and this release knows version "
                f"{tables.VERSION}: restore it with the release that made it"
            )

    def load(self, entry: DatabaseEntry, objects: Objects) -> None:
        """Makes the tables of a PostgreSQL database anew, whatever they held, with the rows of a copy.

        Done again, it makes the same of what an interrupted one has left.
        """
        with tables.one_at_a_time(self.url):
            with _connected(self.url) as connection:
                connection.execute(sa.schema.DropSchema(SCHEMA, cascade=True, if_exists=True))
            engine = sa.create_engine(self.url, poolclass=sa.NullPool)
            tables.make_tables(engine)
            with _connected(self.url, is_patient=True) as connection:
                copied = {one.name: one for one in entry.tables}
                for table in _COPIED:
                    connection.execute(sa.delete(table))  # of what is there from the start
                    one = copied[table.name]
                    _copy_in(connection, one, objects.path(one.sha256))
                    _count_on(connection, table)


@contextmanager
def _connected(url: sa.URL, *, is_patient: bool = False, at_one_moment: bool = False) -> Iterator[sa.Connection]:
    """A transaction, which `is_patient` with long statements, and may only read, but all rows `at_one_moment`."""
    engine = sa.create_engine(url, poolclass=sa.NullPool)
    is_sqlite = engine.dialect.name == "sqlite"
    options: dict[str, Any] = {"schema_translate_map": {SCHEMA: None}} if is_sqlite else {}
    if at_one_moment:
        options |= {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True}
    with engine.connect().execution_options(**options) as connection, connection.begin():
        if is_patient:
            connection.execute(sa.text("SET LOCAL statement_timeout = 0"))
            connection.execute(sa.text("SET LOCAL idle_in_transaction_session_timeout = 0"))
        yield connection


def _states(connection: sa.Connection) -> dict[str, JobState]:
    rows = connection.execute(sa.select(JOBS.c.id, JOBS.c.state).where(JOBS.c.batch.is_(None)))
    return {job_id: JobState(state) for job_id, state in rows}


def _counted(states: Mapping[str, JobState]) -> dict[str, int]:
    return {state.value: sum(one is state for one in states.values()) for state in sorted(set(states.values()))}


def _copy_out(connection: sa.Connection, table: sa.Table, columns: Iterable[str], target: Path) -> int:
    statement = sql.SQL("COPY {} ({}) TO STDOUT").format(sql.Identifier(SCHEMA, table.name), _list_of(columns))
    with _cursor(connection) as cursor, target.open("wb") as file:
        with cursor.copy(statement) as copy:
            for block in copy:
                file.write(block)
        return cursor.rowcount


def _copy_in(connection: sa.Connection, entry: TableEntry, source: Path) -> None:
    statement = sql.SQL("COPY {} ({}) FROM STDIN").format(sql.Identifier(SCHEMA, entry.name), _list_of(entry.columns))
    with _cursor(connection) as cursor, source.open("rb") as file:
        with cursor.copy(statement) as copy:
            while block := file.read(_BLOCK_BYTES):
                copy.write(block)
        if cursor.rowcount != entry.rows:
            raise BackupInvalid(f"the table {entry.name} took {cursor.rowcount} of {entry.rows} rows")


def _count_on(connection: sa.Connection, table: sa.Table) -> None:
    """Lets the numbers that PostgreSQL gives to new rows go on after the highest that there is."""
    name = sql.Identifier(SCHEMA, table.name).as_string()
    for column in table.columns:
        if isinstance(column.type, sa.Integer):  # NULL, to which nothing is set, where it has no numbers of its own
            counter = sa.func.pg_get_serial_sequence(name, column.name)
            connection.execute(sa.select(sa.func.setval(counter, sa.select(sa.func.max(column)).scalar_subquery())))


def _cursor(connection: sa.Connection) -> psycopg.Cursor[Any]:
    """The driver's own, which knows COPY."""
    driver: Any = connection.connection.driver_connection
    cursor: psycopg.Cursor[Any] = driver.cursor()
    return cursor


def _list_of(columns: Iterable[str]) -> sql.Composed:
    return sql.SQL(", ").join(map(sql.Identifier, columns))
