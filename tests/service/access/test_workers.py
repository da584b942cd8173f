"""The workers at the doors of a service: who sees what is at hand, and who lets them rest."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest
import sqlalchemy as sa

from ultragray_proto.v1 import workers_pb2, workers_pb2_grpc
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.tables import WORKERS

from ...waiting import wait_until
from .conftest import Keyed
from .test_audit import entries


@pytest.fixture
def database(keyed: Keyed) -> Iterator[JobDatabase]:
    opened = JobDatabase(keyed.artifact_folder, None)
    yield opened
    with opened.engine.begin() as connection:
        connection.execute(sa.delete(WORKERS))
    opened.close()


def let_work(database: JobDatabase, name: str, job: str | None) -> None:
    """A worker that goes on living, at work on a job, as its heartbeat would write it."""
    with database.engine.begin() as connection:
        facts = {"seen_at_s": time.time() + 3600.0, "host": "bench", "pid": 7, "device": "cpu", "version": "1"}
        connection.execute(sa.insert(WORKERS).values(name=name, job=job, **facts))


def told_http(keyed: Keyed, who: str) -> dict[str, tuple[str, str | None]]:
    answer = keyed.http(who, "GET", "/v1/workers").json()
    return {worker["name"]: (worker["state"], worker["job"]) for worker in answer["workers"]}


def told_grpc(keyed: Keyed, who: str) -> dict[str, tuple[str, str | None]]:
    with keyed.service.channel() as channel:
        stub = workers_pb2_grpc.WorkerServiceStub(channel)
        answer = stub.ListWorkers(workers_pb2.ListWorkersRequest(), metadata=tuple(keyed.headers(who).items()))
    words = workers_pb2.WorkerState.Name
    return {
        worker.name: (words(worker.state).removeprefix("WORKER_STATE_").lower(), worker.job or None)
        for worker in answer.workers
    }


@pytest.mark.parametrize("told", [told_http, told_grpc])
def test_of_a_private_job_others_see_only_that_a_worker_is_busy(keyed: Keyed, database: JobDatabase, told: Any) -> None:
    secret = keyed.submit("alice", private=True).json()["id"]
    shared = keyed.submit("alice").json()["id"]
    for name, job in {"one": secret, "two": shared, "three": None, "four": "0" * 24}.items():
        let_work(database, name, job)
    common = {"two": ("working", shared), "three": ("idle", None), "four": ("working", None)}
    for who, seen in {"alice": secret, "admin": secret, "bob": None, "reader": None}.items():
        assert told(keyed, who) == {"one": ("working", seen), **common}, who


def test_admins_pause_drain_and_resume_over_http(keyed: Keyed, database: JobDatabase) -> None:
    let_work(database, "one", None)
    for wish, state in (("pause", "paused"), ("drain", "drained"), ("resume", "idle")):
        answer = keyed.http("admin", "POST", f"/v1/workers/one:{wish}")
        assert (answer.status_code, answer.json()["state"]) == (200, state)
        assert told_http(keyed, "reader") == {"one": (state, None)}
        refused = keyed.http("alice", "POST", f"/v1/workers/one:{wish}")
        assert (refused.status_code, refused.json()["reason"]) == (403, "PERMISSION_DENIED")
        assert f"worker.{wish} needs the role admin, and alice has operator" in refused.json()["detail"]
        absent = keyed.http("admin", "POST", f"/v1/workers/absent:{wish}")
        assert (absent.status_code, absent.json()["reason"], absent.json()["field"]) == (
            404,
            "WORKER_NOT_FOUND",
            "worker",
        )

    def audited() -> set[tuple[object, ...]]:
        found = entries(keyed.artifact_folder, "--what", "worker")
        return {(one["who"], one["what"], one["target"], one["result"]) for one in found}

    for wish in ("pause", "drain", "resume"):
        expected = {
            ("admin", f"worker.{wish}", "one", "OK"),
            ("alice", f"worker.{wish}", "one", "PERMISSION_DENIED"),
            ("admin", f"worker.{wish}", "absent", "WORKER_NOT_FOUND"),
        }
        wait_until(lambda expected=expected: expected <= audited())
