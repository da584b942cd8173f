"""Who is alive, and whose jobs go back into the queue; without any worker."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import sqlalchemy as sa
from ultragray_workers.jobs.queue.internals import WORKFLOWS

from ultragray_workers.jobs import queue as heartbeat_module
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.store import JobState, JobStore
from ultragray_workers.jobs.workers import Heartbeat

from ....postgres import NewDatabase
from ..conftest import train_job


@pytest.fixture
def database_url(new_database: NewDatabase) -> str | None:
    return new_database()


@pytest.fixture
def running(store: JobStore, jobs: JobDatabase) -> Callable[[str], str]:
    """Makes a job that the worker named runs, by its row; the job's id."""

    def make(executor: str) -> str:
        job, _ = store.submit(train_job(f"scene-of-{executor}"))
        rows = WORKFLOWS
        with jobs.engine.begin() as connection:
            connection.execute(
                sa.update(rows).where(rows.c.workflow_uuid == job.id).values(status="PENDING", executor_id=executor)
            )
        assert store.get(job.id).state is JobState.RUNNING
        return job.id

    return make


@pytest.fixture
def start(jobs: JobDatabase, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Heartbeat]]:
    """Heartbeats that beat at their start only."""
    monkeypatch.setattr(heartbeat_module, "BEAT_INTERVAL_S", 1000.0)
    started: list[Heartbeat] = []

    def start_(executor: str, job_at_hand: str | None = None) -> Heartbeat:
        started.append(Heartbeat(jobs, executor, lambda: job_at_hand))
        return started[-1]

    yield start_
    for heartbeat in started:
        heartbeat.stop()


def test_jobs_of_the_dead_wait_again_and_those_of_the_living_do_not(
    store: JobStore, start: Callable[..., Heartbeat], running: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = start("mine")
    start("other")
    of_other, of_dead = running("other"), running("dead")
    assert mine.take_over() == [of_dead]
    assert store.get(of_dead).state is JobState.QUEUED
    assert mine.take_over() == []
    monkeypatch.setattr(heartbeat_module, "DEAD_AFTER_S", -1.0)
    assert mine.take_over() == [of_other]


def test_own_jobs_that_nobody_is_at_wait_again_after_a_second_look(
    store: JobStore, start: Callable[..., Heartbeat], running: Callable[[str], str]
) -> None:
    forgotten = running("mine")
    mine = start("mine")
    assert mine.take_over() == []  # it may have been taken, or have ended, just now
    assert mine.take_over() == [forgotten]
    assert store.get(forgotten).state is JobState.QUEUED


def test_the_job_at_hand_stays(start: Callable[..., Heartbeat], running: Callable[[str], str]) -> None:
    at_hand = running("mine")
    mine = start("mine", at_hand)
    assert [mine.take_over() for _ in range(3)] == [[], [], []]
