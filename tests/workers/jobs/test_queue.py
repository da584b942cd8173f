"""Every change of a job's row, with no worker: who may take, change and end it; and that no question reads all rows."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import sqlalchemy as sa

from ultragray_workers.errors import StartupFailed
from ultragray_workers.jobs import queue, tables, workers
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.demand import Demand
from ultragray_workers.jobs.owners import Kind, read_owners
from ultragray_workers.jobs.progress import Files, JobState, Outcome, Piece, Progress, StoredFile
from ultragray_workers.jobs.tables import SCHEMA_VERSION
from ultragray_workers.jobs.workers import Heartbeat

from .conftest import train_job

ANY = [Demand("cpu").key]
FILES = Files(
    log=(Piece("jobs/a/log-00000", 7),),
    run={"checkpoint.safetensors": StoredFile("jobs/a/run-1/checkpoint.safetensors", 3, "0" * 64)},
)


@pytest.fixture
def database_url(new_database):
    return new_database()


@pytest.fixture
def engine(jobs):
    return jobs.engine


@pytest.fixture
def start(engine, monkeypatch):
    """Heartbeats that beat at their start only."""
    monkeypatch.setattr(workers, "BEAT_INTERVAL_S", 1000.0)
    started = []

    def start_(worker):
        started.append(Heartbeat(engine, worker, lambda: None))
        return started[-1]

    yield start_
    for heartbeat in started:
        heartbeat.stop()


def taken(engine, worker):
    row = queue.take(engine, worker, ANY)
    assert row is not None
    return row


def test_jobs_are_taken_by_priority_then_in_the_order_of_submission(store, engine):
    ids = [
        store.submit(train_job(f"scene-{number}"), priority=priority)[0].id
        for number, priority in [(0, 0), (1, 5), (2, 0)]
    ]
    assert [taken(engine, "one").id for _ in ids] == [ids[1], ids[0], ids[2]]
    assert queue.take(engine, "one", ANY) is None
    assert queue.take(engine, "one", []) is None


def test_of_many_workers_one_takes_a_job(store, engine):
    ids = {store.submit(train_job(f"scene-{number}"))[0].id for number in range(6)}
    together = threading.Barrier(4)

    def take_all(worker):
        together.wait()
        found = []
        while (row := queue.take(engine, worker, ANY)) is not None:
            found.append(row.id)
        return found

    with ThreadPoolExecutor(4) as threads:
        found = [job_id for some in threads.map(take_all, "abcd") for job_id in some]
    assert sorted(found) == sorted(ids)


def test_a_worker_takes_only_jobs_with_its_demands(store, engine):
    in_lab, _ = store.submit(replace(train_job("lab"), worker_labels={"site": "lab1"}))
    anywhere, _ = store.submit(train_job("anywhere"))
    assert taken(engine, "one").id == anywhere.id
    row = queue.take(engine, "one", queue.demands_waiting(engine))
    assert row.id == in_lab.id


def test_an_owner_has_no_more_running_than_it_may(store, engine):
    for number in range(2):
        store.submit(train_job(f"scene-{number}"), owner="ann", admit=lambda jobs: 1)
    others, _ = store.submit(train_job("others"), owner="bob", admit=lambda jobs: 1)
    first = taken(engine, "one")
    assert taken(engine, "two").id == others.id
    assert queue.take(engine, "three", ANY) is None
    assert queue.finish(engine, first, Outcome(), Files())
    assert taken(engine, "three").owner == "ann"


def test_what_a_worker_writes_holds_for_its_own_attempt(store, engine):
    job, _ = store.submit(train_job("one"))
    first = taken(engine, "one")
    assert queue.tell(engine, first, Progress(step=3, steps=20), FILES)
    assert store.get(job.id).progress.step == 3
    assert queue.put_back(engine, first)
    second = taken(engine, "two")
    assert (second.id, second.attempt, second.files, second.progress) == (job.id, 2, FILES, Progress(step=3, steps=20))
    for change in (
        lambda: queue.tell(engine, first, Progress(step=4), Files()),
        lambda: queue.publish(engine, first, Outcome(), Files()),
        lambda: queue.finish(engine, first, Outcome(), Files()),
        lambda: queue.put_back(engine, first),
    ):
        assert not change()
    assert not queue.is_held(engine, first)
    assert queue.is_held(engine, second)
    failed = Outcome("INTERNAL", "it broke", metrics={"psnr_db": 20.5}, progress=Progress(step=5), attempts=2)
    assert queue.finish(engine, second, failed, FILES)
    told = store.get(job.id)
    assert (told.state, told.error, told.reason, told.attempts) == (JobState.FAILED, "INTERNAL", "it broke", 2)
    assert (told.metrics, told.progress.step) == ({"psnr_db": 20.5}, 5)


def test_a_job_that_was_taken_and_not_begun_counts_no_attempt(store, engine):
    job, _ = store.submit(train_job("one"))
    assert queue.put_back(engine, taken(engine, "one"), is_untouched=True)
    assert (store.get(job.id).attempts, store.get(job.id).worker) == (0, None)
    assert taken(engine, "one").attempt == 1


def test_a_job_is_published_or_cancelled_whichever_comes_first(store, engine):
    job, _ = store.submit(train_job("one"), owner="ann")
    row = taken(engine, "one")
    assert queue.publish(engine, row, Outcome(artifacts=("one.ugr",)), FILES)
    assert not queue.cancel(engine, job.id)
    assert queue.put_back(engine, row)  # its worker died: whoever takes it over serves the scene
    again = taken(engine, "two")
    assert again.published
    assert again.outcome == Outcome(artifacts=("one.ugr",))
    other, _ = store.submit(train_job("two"), owner="ann")
    row = taken(engine, "one")
    assert queue.cancel(engine, other.id)
    assert not queue.publish(engine, row, Outcome(), Files())
    assert queue.tell(engine, row, Progress(step=7), FILES)  # a retry goes on from there
    assert store.submit(train_job("two"), owner="bob")[1]  # the name is free again


@pytest.mark.parametrize("is_running", [False, True])
def test_a_cancelled_job_gives_the_name_of_its_scene_back_at_once(store, engine, is_running):
    """To ask for the name would also forget a claim of a job that is over: whoever lists owners asks for none."""
    job, _ = store.submit(train_job("one"), owner="ann")
    with engine.connect() as connection:
        assert read_owners(connection).keys() == {(Kind.SCENE, "one")}
    if is_running:
        taken(engine, "one")
    assert queue.cancel(engine, job.id)
    with engine.connect() as connection:
        assert read_owners(connection) == {}


def test_jobs_of_the_dead_wait_again_and_those_of_the_living_do_not(store, engine, start, monkeypatch):
    mine, _ = start("mine"), start("other")
    for number in range(2):
        store.submit(train_job(f"scene-{number}"))
    of_other, of_dead = taken(engine, "other"), taken(engine, "dead")
    assert mine.take_over() == [of_dead.id]
    assert store.get(of_dead.id).state is JobState.QUEUED
    assert mine.take_over() == []
    monkeypatch.setattr(queue, "DEAD_AFTER_S", -1.0)
    assert mine.take_over() == [of_other.id]


def test_a_worker_that_begins_lets_its_own_jobs_wait_again(store, engine):
    for number in range(2):
        store.submit(train_job(f"scene-{number}"))
    mine, _ = taken(engine, "mine"), taken(engine, "other")
    assert queue.put_back_of(engine, "mine") == [mine.id]
    assert queue.put_back_of(engine, "mine") == []


def test_answers_about_jobs_that_wait_or_run(store, engine):
    running, waiting, over = (store.submit(train_job(scene))[0] for scene in ("running", "waiting", "over"))
    assert taken(engine, "one").id == running.id
    store.cancel(over.id)
    assert queue.successor(engine, over.id) is None
    after, _ = store.retry(over.id)
    assert queue.count_waiting(engine) == 2
    assert {row.id for name in ("running", "over") if (row := queue.find(engine, makes_scene=name))} == {
        running.id,
        after.id,
    }
    assert queue.find(engine, makes_scene="none") is None
    found = queue.find(engine, needs_dataset="tiny")
    assert found.id in {waiting.id, running.id, after.id}
    assert queue.successor(engine, over.id) == after.id
    assert queue.finished_ago(engine, -1e9, set(), 10) == []  # a job goes on from it
    store.cancel(after.id)
    assert set(queue.finished_ago(engine, -1e9, set(), 10)) == {over.id, after.id}
    assert queue.finished_ago(engine, -1e9, {over.id, after.id}, 10) == []


def test_the_demands_that_wait_are_told_once_each(store, engine):
    assert queue.demands_waiting(engine) == []
    in_lab = replace(train_job("one"), worker_labels={"site": "lab1"})
    for scene in ("one", "two", "three"):
        store.submit(replace(in_lab, scene=scene))
        store.submit(train_job(f"{scene}-anywhere"))
    gone, _ = store.submit(replace(train_job("gone"), device="cuda"))
    store.cancel(gone.id)
    expected = [Demand("cpu"), Demand("cpu", labels=(("site", "lab1"),))]
    assert sorted(queue.demands_waiting(engine)) == sorted(demand.key for demand in expected)


@pytest.mark.parametrize(
    "ask",
    [
        queue.count_waiting,
        queue.demands_waiting,
        lambda engine: queue.take(engine, "me", ANY),
        lambda engine: queue.row_of(engine, "0" * 24),
        lambda engine: queue.count_of_owner(engine, "me"),
        lambda engine: queue.successor(engine, "0" * 24),
        lambda engine: queue.put_back_of_dead(engine),
    ],
)
def test_no_question_reads_all_rows(engine, ask):
    asked = []

    def listen(connection, cursor, statement, parameters, *_):
        asked.append((statement, parameters))

    sa.event.listen(engine, "before_cursor_execute", listen)
    ask(engine)
    (statement, parameters) = asked[0]
    is_sqlite = engine.dialect.name == "sqlite"
    with engine.begin() as connection:
        if not is_sqlite:  # of a table so small it reads all, if it may
            connection.exec_driver_sql("SET LOCAL enable_seqscan = off")
        explain = "EXPLAIN QUERY PLAN" if is_sqlite else "EXPLAIN"
        plan = "\n".join(map(str, connection.exec_driver_sql(f"{explain} {statement}", parameters)))
    assert "SCAN jobs\n" not in f"{plan}\n".replace("'", "\n"), plan
    assert "Seq Scan on jobs" not in plan, plan


def test_tables_of_another_release_are_refused_and_stay(jobs, artifact_folder, database_url):
    with jobs.engine.begin() as connection:
        connection.execute(sa.update(SCHEMA_VERSION).values(version=tables.VERSION + 1))
    with pytest.raises(StartupFailed, match=f"version {tables.VERSION + 1}, and this release knows version") as caught:
        JobDatabase(artifact_folder, database_url)
    assert caught.value.field == "database_url"
