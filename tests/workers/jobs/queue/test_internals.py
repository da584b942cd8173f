"""What the queue takes from DBOS beyond its public interface is still there, and means the same."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest
import sqlalchemy as sa
from dbos import DBOSClient
from ultragray_workers.jobs.queue.internals import SQLITE_ISOLATION, SQLITE_SETTINGS, WORKFLOWS, put_back

from ultragray_workers.jobs.database import QUEUE, SERIALIZER, JobDatabase
from ultragray_workers.jobs.store import Job, JobState, JobStore

from ....postgres import NewDatabase
from ..conftest import RunningWorker, train_job


@pytest.fixture
def database_url(new_database: NewDatabase) -> str | None:
    return new_database()


def test_the_columns_are_those_of_the_table(jobs: JobDatabase) -> None:
    schema = None if jobs.engine.dialect.name == "sqlite" else WORKFLOWS.schema
    there = {column["name"]: column["type"] for column in sa.inspect(jobs.engine).get_columns(WORKFLOWS.name, schema)}
    assert {column.name for column in WORKFLOWS.columns} <= set(there)
    assert isinstance(there["created_at"], sa.Integer)  # ms: jobs are served and listed by it


def test_the_time_of_submission_can_be_set_and_orders_the_queue(jobs: JobDatabase, store: JobStore) -> None:
    first, second = (store.submit(train_job(scene))[0] for scene in ("one", "two"))
    with jobs.engine.begin() as connection:
        moved = sa.update(WORKFLOWS).where(WORKFLOWS.c.workflow_uuid == first.id)
        connection.execute(moved.values(created_at=int(time.time() * 1000) + 60_000))
    assert [row.workflow_id for row in jobs.client.list_workflows()] == [second.id, first.id]


def test_only_a_running_job_of_that_worker_is_put_back(jobs: JobDatabase, store: JobStore) -> None:
    job, _ = store.submit(train_job("one"))

    def set_row(**values: Any) -> None:
        with jobs.engine.begin() as connection:
            connection.execute(sa.update(WORKFLOWS).where(WORKFLOWS.c.workflow_uuid == job.id).values(**values))

    set_row(status="PENDING", executor_id="dead")
    assert not put_back(jobs.client, job.id, "another", QUEUE)
    assert put_back(jobs.client, job.id, "dead", QUEUE)
    assert store.get(job.id).state is JobState.QUEUED
    assert not put_back(jobs.client, job.id, "dead", QUEUE)
    set_row(status="CANCELLED", executor_id="dead")
    assert not put_back(jobs.client, job.id, "dead", QUEUE)
    assert store.get(job.id).state is JobState.CANCELLED


@pytest.mark.long
def test_an_owner_with_enough_running_jobs_waits_while_others_go_first(
    store: JobStore, start_worker: Callable[..., RunningWorker], until: Callable[..., Any]
) -> None:
    def submit(scene: str, owner: str, most: int | None) -> Job:
        return store.submit(train_job(scene, steps=4000), owner=owner, admit=lambda jobs: most)[0]

    first, second = submit("one", "alice", 1), submit("two", "alice", 1)
    start_worker("one", host="first")
    until(first, lambda job: job.state is JobState.RUNNING)
    start_worker("two", host="second")
    third = submit("three", "bob", 1)
    until(third, lambda job: job.state is not JobState.QUEUED)
    assert store.get(second.id).state is JobState.QUEUED
    store.cancel(first.id)
    until(second, lambda job: job.state is not JobState.QUEUED)
    for job in (second, third):
        store.cancel(job.id)


@pytest.mark.parametrize("new_database", ["sqlite"], indirect=True)
def test_our_engine_is_set_up_like_the_one_that_dbos_makes(jobs: JobDatabase) -> None:
    theirs = DBOSClient(system_database_url=jobs.url, serializer=SERIALIZER)
    for engine in (jobs.engine, theirs._sys_db.engine):
        with engine.connect() as connection:
            values = {name: connection.exec_driver_sql(f"PRAGMA {name}").scalar() for name in SQLITE_SETTINGS}
            assert values == SQLITE_SETTINGS
            assert connection.connection.dbapi_connection.isolation_level == SQLITE_ISOLATION
    theirs.destroy()


@pytest.mark.long
@pytest.mark.parametrize("new_database", ["sqlite"], indirect=True)
def test_an_interrupted_execution_is_no_end_of_its_job(
    store: JobStore, start_worker: Callable[..., RunningWorker], until: Callable[..., Any]
) -> None:
    """The worker that loses a job to another (here: to the queue) raises NotMine; the job stays what it is."""
    job, _ = store.submit(train_job("one", steps=2000))
    worker = start_worker("one")
    until(job, lambda job: job.state is JobState.RUNNING and job.progress.step)
    assert worker.terminate() == 0
    assert store.get(job.id).state is JobState.QUEUED
    store.cancel(job.id)
