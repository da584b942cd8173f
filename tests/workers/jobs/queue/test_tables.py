"""Our own tables beside those of DBOS: made once however many start at once, of the version that the code says."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import sqlalchemy as sa
from ultragray_workers.jobs.queue.internals import QUEUE_VERSION, SCHEMA, latest_queue_version

from ultragray_workers.errors import StartupFailed
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.queue import tables

from ....postgres import NewDatabase

STARTS = 4
OPEN = """
import sys
from pathlib import Path
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.queue.internals import SCHEMA
sys.stdin.readline()
JobDatabase(Path(sys.argv[1]), sys.argv[2] or None).close()
"""


@pytest.fixture
def database_url(new_database: NewDatabase) -> str | None:
    return new_database()


@pytest.mark.long
def test_processes_that_open_a_new_database_at_once_all_find_its_tables(
    tmp_path: Path, database_url: str | None
) -> None:
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", OPEN, str(tmp_path), database_url or ""],
            env={"PYTHONPATH": ":".join(path for path in sys.path if path)},
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for _ in range(STARTS)
    ]
    for process in processes:
        assert process.stdin is not None
        process.stdin.write(b"\n")
        process.stdin.flush()
    failures = [process.communicate()[1].decode() for process in processes]
    assert [process.returncode for process in processes] == [0] * STARTS, failures


def test_tables_have_the_columns_that_the_code_uses(tmp_path: Path, database_url: str | None) -> None:
    jobs = JobDatabase(tmp_path, database_url)
    columns = sa.inspect(jobs.engine).get_columns
    schema = None if database_url is None else SCHEMA
    for table in tables.TABLES.tables.values():
        found = {column["name"] for column in columns(table.name, schema=schema)}
        assert found == {column.name for column in table.columns}
    jobs.close()


def test_tables_of_a_newer_release_are_refused_in_words(tmp_path: Path, database_url: str | None) -> None:
    jobs = JobDatabase(tmp_path, database_url)
    with jobs.engine.begin() as connection:
        connection.execute(sa.update(tables.SCHEMA_VERSION).values(version=tables.VERSION + 1))
    jobs.close()
    with pytest.raises(StartupFailed, match=f"tables of version {tables.VERSION + 1}.*up to version {tables.VERSION}"):
        JobDatabase(tmp_path, database_url)


def test_tables_of_a_newer_queue_are_refused_in_words(tmp_path: Path, database_url: str | None) -> None:
    jobs = JobDatabase(tmp_path, database_url)
    known = latest_queue_version(jobs.engine.dialect.name)
    with jobs.engine.begin() as connection:
        connection.execute(sa.update(QUEUE_VERSION).values(version=known + 1))
    jobs.close()
    with pytest.raises(StartupFailed, match=f"tables of the queue of version {known + 1}.*up to version {known}"):
        JobDatabase(tmp_path, database_url)


def test_registrations_of_private_scenes_stay_private_where_version_10_is_made(
    tmp_path: Path, database_url: str | None
) -> None:
    jobs = JobDatabase(tmp_path, database_url)
    place = "" if database_url is None else f"{SCHEMA}."
    with jobs.engine.begin() as connection:
        tables.TABLES.drop_all(connection)
        tables.migrate_to(connection, 9)
        for name, private in {"patient": True, "phantom": False}.items():
            owner = {"kind": "scene", "name": name, "owner": "alice", "private": private}
            connection.execute(sa.insert(tables.OWNERS).values(owner))
            row = {"name": f"of-{name}", "scene": name, "owner": "bob", "changed_at_s": 0.0, "document": "{}"}
            connection.execute(
                sa.text(
                    f"INSERT INTO {place}ultragray_registrations (name, scene, owner, changed_at_s, document) "
                    "VALUES (:name, :scene, :owner, :changed_at_s, :document)"
                ),
                row,
            )
    jobs.close()
    jobs = JobDatabase(tmp_path, database_url)
    with jobs.engine.connect() as connection:
        columns = tables.REGISTRATIONS.c
        found = {row.name: row.private_to for row in connection.execute(sa.select(columns.name, columns.private_to))}
    assert found == {"of-patient": "alice", "of-phantom": None}
    jobs.close()


def test_a_database_from_before_versions_is_brought_to_this_one(tmp_path: Path, database_url: str | None) -> None:
    jobs = JobDatabase(tmp_path, database_url)
    with jobs.engine.begin() as connection:
        tables.TABLES.drop_all(connection)
        tables.STEPS[0](connection)
    jobs.close()
    jobs = JobDatabase(tmp_path, database_url)
    with jobs.engine.connect() as connection:
        assert connection.execute(sa.select(tables.SCHEMA_VERSION.c.version)).scalars().all() == [tables.VERSION]
    jobs.close()
