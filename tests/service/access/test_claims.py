"""A name belongs to whoever claimed it first, and no longer than what it names is there or being made."""

import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import httpx
import pytest
import sqlalchemy as sa

from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.tables import OWNERS

from ...waiting import wait_until


@pytest.fixture(scope="module")
def database(keyed):
    database = JobDatabase(keyed.artifact_folder, None)
    yield database
    database.close()


def owner_of(database, kind, name):
    with database.engine.connect() as connection:
        return connection.execute(
            sa.select(OWNERS.c.owner).where(OWNERS.c.kind == kind, OWNERS.c.name == name)
        ).scalar()


@contextmanager
def held_back(keyed, who, path, content):
    """The answer to an upload whose last bytes are sent when the body of the context ends."""
    release = threading.Event()

    def parts():
        yield content[:100]
        release.wait()
        yield content[100:]

    def put():
        return httpx.put(f"{keyed.service.http}{path}", content=parts(), headers=keyed.headers(who), timeout=300)

    with ThreadPoolExecutor(1) as executor:
        try:
            answer = executor.submit(put)
            wait_until(lambda: any((keyed.artifact_folder / "scenes").glob(".importing-*")))
            yield answer
        finally:
            release.set()


def train(keyed, who, dataset, scene, *, private=False):
    body = {"kind": "train", "specification": {"dataset": dataset, "scene": scene}, "private": private}
    return keyed.http(who, "POST", "/v1/jobs", json=body)


@pytest.fixture(scope="module")
def dataset(keyed, dataset_bytes):
    answer = keyed.http("alice", "PUT", "/v1/datasets/common", content=dataset_bytes)
    assert answer.status_code == 201, answer.text
    return "common"


def test_a_slow_import_takes_no_training_over(keyed, database, dataset, scene_bytes):
    with held_back(keyed, "bob", "/v1/scenes/spine?private=true", scene_bytes) as late:
        assert train(keyed, "alice", dataset, "spine", private=True).status_code == 201
    assert (late.result().status_code, late.result().json()["reason"]) == (409, "SCENE_EXISTS")
    assert owner_of(database, "scene", "spine") == "alice"


@pytest.mark.long
def test_a_claim_that_a_dead_service_left_keeps_nobody_out(keyed, database, dataset, scene_bytes, dataset_bytes):
    left = [("scene", "left"), ("scene", "left-too"), ("dataset", "left")]
    with database.engine.begin() as connection:
        for kind, name in left:
            connection.execute(
                sa.insert(OWNERS).values(kind=kind, name=name, owner="bob", private=True, claim=".importing-0")
            )
    assert keyed.http("alice", "PUT", "/v1/scenes/left", content=scene_bytes).status_code == 201
    assert keyed.http("alice", "PUT", "/v1/datasets/left", content=dataset_bytes).status_code == 201
    assert train(keyed, "alice", dataset, "left-too").status_code == 201
    assert {owner_of(database, kind, name) for kind, name in left} == {"alice"}
    wait_until(lambda: keyed.http("bob", "GET", "/v1/scenes/left").status_code == 200)


def put_file(keyed, name):
    """A scene that an administrator puts into the data folder."""
    path = keyed.service.data_folder / f"{name}.ugr"
    path.write_bytes((keyed.service.data_folder / "demo.ugr").read_bytes())
    return path


def test_an_upload_that_fails_leaves_no_claim(keyed, database):
    for path in ("/v1/scenes/broken", "/v1/datasets/broken"):
        assert keyed.http("bob", "PUT", f"{path}?private=true", content=b"PK broken" * 1000).status_code == 422
    assert owner_of(database, "scene", "broken") is None
    assert owner_of(database, "dataset", "broken") is None
    path = put_file(keyed, "broken")
    try:
        assert keyed.http("reader", "GET", "/v1/scenes/broken").status_code == 200
    finally:
        path.unlink()
