"""Named keys: made and revoked by the command line, while a service runs."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import sqlalchemy as sa
from typer.testing import Result

from ultragray.errors import InvalidArgument
from ultragray_service.access.keys import KeyStore, KnownKeys, Snapshot
from ultragray_service.access.principals import Principal, Role
from ultragray_service.errors import Unauthenticated
from ultragray_workers.errors import DatabaseUnavailable
from ultragray_workers.jobs import tables
from ultragray_workers.jobs.database import JobDatabase

from ...postgres import NewDatabase, PostgresServer
from ...waiting import wait_until
from ..cli.command_line import run
from ..conftest import StartService


@pytest.fixture
def database_url(new_database: NewDatabase) -> str | None:
    return new_database()


@pytest.fixture
def database(tmp_path: Path, database_url: str | None) -> Iterator[JobDatabase]:
    opened = JobDatabase(tmp_path, database_url)
    yield opened
    opened.close()


def keys(folder: Path, *arguments: object) -> Result:
    return run("keys", *arguments, "--artifact-folder", folder)


def test_a_key_is_known_by_its_secret_which_is_nowhere_kept(database: JobDatabase) -> None:
    store, known = KeyStore(database.engine), KnownKeys()
    key, secret = store.create("alice", Role.OPERATOR, 90.0)
    known.replace(store.keys())
    assert known.authenticate(secret) == Principal("alice", Role.OPERATOR, key.id, key.expires_at_s)
    assert known.authenticate(secret[:-1]) is None
    assert len(secret) >= 43  # 256 bits
    with database.engine.connect() as connection:
        row = connection.execute(sa.select(tables.KEYS)).one()
    assert secret not in str(row)
    assert row.expires_at_s - row.created_at_s == pytest.approx(90 * 86400)


def test_revoking_a_name_revokes_all_its_keys_and_an_id_one(database: JobDatabase) -> None:
    store = KeyStore(database.engine)
    first, _ = store.create("alice", Role.READER, None)
    second, secret = store.create("alice", Role.ADMIN, None)
    other, _ = store.create("bob", Role.READER, None)
    assert [key.id for key in store.revoke(first.id)] == [first.id]
    assert [key.id for key in store.revoke("alice")] == [second.id]
    assert store.revoke("alice") == []
    with pytest.raises(InvalidArgument, match="no key of the name or id 'carol'"):
        store.revoke("carol")
    known = KnownKeys()
    known.replace(store.keys())
    with pytest.raises(Unauthenticated, match="was revoked"):
        known.authenticate(secret)
    assert [key.id for key in store.keys().values() if key.is_valid(time.time())] == [other.id]


@pytest.mark.parametrize("name", ["", "oidc:alice", "a b", "-", "x" * 65, "local:"])
def test_names_that_other_sources_may_give_are_refused(database: JobDatabase, name: str) -> None:
    with pytest.raises(InvalidArgument, match="name must be"):
        KeyStore(database.engine).create(name, Role.READER, None)


def test_a_snapshot_follows_the_keys_and_writes_when_they_were_used(database: JobDatabase) -> None:
    store, known = KeyStore(database.engine), KnownKeys()
    snapshot = Snapshot(database.engine, known, ())
    try:
        assert not known.is_used
        key, secret = store.create("alice", Role.READER, None)
        wait_until(lambda: known.authenticate(secret) is not None)
        store.note_uses(known.take_uses())
        (kept,) = store.keys().values()
        assert kept.id == key.id
        assert kept.last_used_at_s == pytest.approx(time.time(), abs=60)
    finally:
        snapshot.close()


def test_a_snapshot_outlives_the_database(tmp_path: Path, postgres: PostgresServer) -> None:
    database = JobDatabase(tmp_path, postgres.create_database())
    store, known = KeyStore(database.engine), KnownKeys()
    _, secret = store.create("alice", Role.READER, None)
    snapshot = Snapshot(database.engine, known, ())
    try:
        postgres.stop()
        try:
            with pytest.raises(DatabaseUnavailable):
                snapshot.refresh()
            assert known.authenticate(secret) is not None
        finally:
            postgres.start()
        store.revoke("alice")

        def is_revoked() -> bool:
            try:
                return known.authenticate(secret) is None
            except Unauthenticated:
                return True

        wait_until(is_revoked)
    finally:
        snapshot.close()
        database.close()


def test_keys_are_made_and_revoked_without_a_restart(start_service: StartService, tmp_path: Path) -> None:
    service = start_service(artifact_folder=tmp_path)
    routes = f"{service.http}/v1/scenes"
    assert httpx.get(routes, timeout=60).status_code == 200

    made = keys(tmp_path, "create", "alice", "--role", "reader", "--expires-days", "90")
    assert made.exit_code == 0, made.stderr
    assert made.stdout.count("\n") == 1  # alone, for scripts
    assert "alice" in made.stderr
    assert made.stdout.strip() not in made.stderr
    headers = {"Authorization": f"Bearer {made.stdout.strip()}"}
    wait_until(lambda: httpx.get(routes, timeout=60).status_code == 401)  # from the first key on
    assert httpx.get(routes, headers=headers, timeout=60).status_code == 200

    (listed,) = json.loads(keys(tmp_path, "list", "--json").stdout)
    assert (listed["name"], listed["role"], listed["state"]) == ("alice", "reader", "valid")
    assert made.stdout.strip() not in json.dumps(listed)
    assert keys(tmp_path, "revoke", "alice").exit_code == 0
    wait_until(lambda: httpx.get(routes, headers=headers, timeout=60).status_code == 401)
    assert "revoked" in keys(tmp_path, "list").stdout
    assert keys(tmp_path, "revoke", "nobody").exit_code == 2
