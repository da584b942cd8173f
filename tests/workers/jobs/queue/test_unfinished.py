"""Questions about the jobs that wait or run: their answers, and that they do not read the whole table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import sqlalchemy as sa
from ultragray_workers.jobs.queue.internals import WORKFLOWS

from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.demand import Demand
from ultragray_workers.jobs.queue import database, unfinished
from ultragray_workers.jobs.store import JobStore

from ....postgres import NewDatabase
from ..conftest import train_job


@pytest.fixture
def database_url(new_database: NewDatabase) -> str | None:
    return new_database()


def test_answers(jobs: JobDatabase, store: JobStore) -> None:
    waiting, running, over = (store.submit(train_job(scene))[0] for scene in ("waiting", "running", "over"))
    store.cancel(over.id)
    assert unfinished.successor(jobs, over.id) is None
    after, _ = store.retry(over.id)
    with jobs.engine.begin() as connection:
        of_running = sa.update(WORKFLOWS).where(WORKFLOWS.c.workflow_uuid == running.id)
        connection.execute(of_running.values(status="PENDING", executor_id="me"))
    assert unfinished.running(jobs) == [(running.id, "me")]
    assert unfinished.count_waiting(jobs) == 2
    assert unfinished.naming(jobs, "makes_scene", "running") == running.id
    assert unfinished.naming(jobs, "makes_scene", "over") == after.id
    assert unfinished.naming(jobs, "needs_dataset", "tiny") in {waiting.id, running.id, after.id}
    assert unfinished.naming(jobs, "needs_scene", "running") is None
    assert unfinished.successor(jobs, over.id) == after.id
    assert unfinished.sources(jobs) == {over.id}
    store.cancel(after.id)
    assert unfinished.sources(jobs) == set()


def test_the_demands_that_wait_are_told_once_each(jobs: JobDatabase, store: JobStore) -> None:
    assert unfinished.demands_waiting(jobs) == []
    in_lab = replace(train_job("one"), worker_labels={"site": "lab1"})
    for scene in ("one", "two", "three"):
        store.submit(replace(in_lab, scene=scene))
        store.submit(train_job(f"{scene}-anywhere"))
    gone, _ = store.submit(replace(train_job("gone"), device="cuda"))
    store.cancel(gone.id)
    expected = [Demand("cpu"), Demand("cpu", labels=(("site", "lab1"),))]
    assert sorted(unfinished.demands_waiting(jobs)) == sorted(demand.key for demand in expected)


def test_a_job_of_an_older_release_gets_its_demand_when_it_is_adopted(jobs: JobDatabase, store: JobStore) -> None:
    older, running = (store.submit(train_job(scene))[0] for scene in ("older", "running"))
    with jobs.engine.begin() as connection:
        as_before = sa.update(WORKFLOWS).values(queue_partition_key=None, application_version="2")
        connection.execute(as_before)
        connection.execute(as_before.where(WORKFLOWS.c.workflow_uuid == running.id).values(status="PENDING"))
    assert store.get(older.id).progress.waits_for == "a worker with the device cpu: none is running"
    assert unfinished.demands_waiting(jobs) == []
    unfinished.adopt_older(jobs)
    assert unfinished.demands_waiting(jobs) == [Demand("cpu").key]
    with jobs.engine.begin() as connection:
        versions = connection.execute(sa.select(WORKFLOWS.c.workflow_uuid, WORKFLOWS.c.application_version)).all()
    assert {tuple(row) for row in versions} == {(older.id, database.VERSION), (running.id, "2")}


@pytest.mark.parametrize(
    "ask",
    [
        unfinished.running,
        unfinished.count_waiting,
        unfinished.demands_waiting,
        unfinished.sources,
        lambda jobs: unfinished.count_of_owner(jobs, "me"),
        lambda jobs: unfinished.naming(jobs, "needs_dataset", "tiny"),
        lambda jobs: unfinished.successor(jobs, "0" * 24),
    ],
)
def test_no_question_reads_all_rows(jobs: JobDatabase, ask: Callable[[JobDatabase], Any]) -> None:
    asked: list[tuple[str, Any]] = []

    def listen(connection: Any, cursor: Any, statement: str, parameters: Any, *_: Any) -> None:
        asked.append((statement, parameters))

    sa.event.listen(jobs.engine, "before_cursor_execute", listen)
    ask(jobs)
    (statement, parameters) = asked[-1]
    is_sqlite = jobs.engine.dialect.name == "sqlite"
    with jobs.engine.begin() as connection:
        if not is_sqlite:  # of a table so small it reads all, if it may
            connection.exec_driver_sql("SET LOCAL enable_seqscan = off")
        explain = "EXPLAIN QUERY PLAN" if is_sqlite else "EXPLAIN"
        plan = "\n".join(map(str, connection.exec_driver_sql(f"{explain} {statement}", parameters)))
    assert "idx_workflow_status_" in plan, plan
