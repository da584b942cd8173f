"""Jobs that go: deleted by hand, or old. And datasets that go while a job is submitted."""

import os
import time

import pytest
import sqlalchemy as sa

from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import DatasetInUse, DatasetNotFound, JobInUse, JobNotFound
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.folder import WORK
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.tables import JOBS
from ultragray_workers.jobs.worker import worker as housekeeping
from ultragray_workers.jobs.worker.worker import DAY_S, Housekeeper
from ultragray_workers.storage.local import LocalStorage

from .conftest import train_job


@pytest.fixture
def database_url(new_database):
    return new_database()


@pytest.fixture
def finished(store, jobs, artifact_folder):
    """Makes a cancelled job that ended so many days ago, with files as its worker would have left them."""

    def make(scene, days_ago=0.0):
        job = store.cancel(store.submit(train_job(scene))[0].id)
        ended_ms = int((time.time() - days_ago * DAY_S) * 1000)
        with jobs.engine.begin() as connection:
            connection.execute(sa.update(JOBS).where(JOBS.c.id == job.id).values(finished_ms=ended_ms))
        return job, make_files(artifact_folder, job.id, days_ago)

    return make


def make_files(artifact_folder, job_id, days_ago, folder="jobs"):
    made = artifact_folder / folder / job_id
    (made / "artifacts").mkdir(parents=True)
    (made / "artifacts" / "metrics.json").write_text("{}")
    for path in (made / "artifacts" / "metrics.json", made):
        os.utime(path, (time.time() - days_ago * DAY_S,) * 2)
    return made


def left(artifact_folder, folder="jobs"):
    return {path.name for path in (artifact_folder / folder).iterdir()}


def test_a_finished_job_goes_with_its_files_and_its_request_id_is_free(store, artifact_folder, finished):
    job, _ = store.submit(train_job("named"), request_id="mine")
    store.cancel(job.id)
    store.delete(job.id)
    again, is_new = store.submit(train_job("named"), request_id="mine")
    assert is_new
    with pytest.raises(JobInUse, match="queued"):
        store.delete(again.id)
    other, _ = finished("other")
    (artifact_folder / "scenes").mkdir()
    (artifact_folder / "scenes" / "other.ugr").touch()
    store.delete(other.id)
    assert left(artifact_folder) == set()
    assert (artifact_folder / "scenes" / "other.ugr").exists()
    for call in (store.get, store.delete):
        with pytest.raises(JobNotFound):
            call(other.id)


def test_what_another_job_goes_on_from_stays(store, finished):
    job, folder = finished("one")
    successor, _ = store.retry(job.id)
    with pytest.raises(JobInUse, match=successor.id):
        store.delete(job.id)
    store.cancel(successor.id)
    store.delete(job.id)
    assert not folder.exists()


def test_jobs_are_counted_by_state(store, finished):
    finished("one")
    finished("two")
    store.submit(train_job("three"))
    assert store.overview().counts == {
        JobState.QUEUED: 1,
        JobState.RUNNING: 0,
        JobState.SUCCEEDED: 0,
        JobState.FAILED: 0,
        JobState.CANCELLED: 2,
    }


def test_old_jobs_go_and_what_is_needed_stays(store, jobs, artifact_folder, finished, monkeypatch):
    monkeypatch.setattr(housekeeping, "AT_ONCE", 2)
    monkeypatch.setattr(housekeeping, "STEP_PAUSE_S", 0.0)
    old = [finished(f"old-{number}", 31)[0] for number in range(3)]
    young, _ = finished("young", 29)
    source, _ = finished("source", 40)
    successor, _ = store.retry(source.id)
    make_files(artifact_folder, "0" * 24, 1.1)  # of a submission that failed
    make_files(artifact_folder, "1" * 24, 0.9)
    make_files(artifact_folder, "not-a-job", 99)
    make_files(artifact_folder, f"{'2' * 24}.1", 1.1, WORK)  # of a worker that died
    make_files(artifact_folder, f"{young.id}.1", 1.1, WORK)

    def keep_house():
        return Housekeeper(jobs, artifact_folder, LocalStorage(artifact_folder), 30).keep_house()

    assert keep_house() == len(old) + 2
    kept = {young.id, source.id}
    assert left(artifact_folder) == kept | {"1" * 24, "not-a-job"}
    assert left(artifact_folder, WORK) == {f"{young.id}.1"}
    assert {job.id for job in store.list()[0]} == kept | {successor.id}
    store.cancel(successor.id)
    assert keep_house() == 1
    assert source.id not in left(artifact_folder)


def test_a_host_whose_clock_is_ahead_removes_no_job(jobs, artifact_folder, finished, monkeypatch):
    finished("young", 29)
    ahead_s = time.time() + 2 * DAY_S
    monkeypatch.setattr(time, "time", lambda: ahead_s)
    assert Housekeeper(jobs, artifact_folder, LocalStorage(artifact_folder), 30).keep_house() == 0


def test_a_deletion_and_a_submission_at_once_never_both_succeed(store, artifact_folder, monkeypatch):
    datasets = DatasetStore(artifact_folder)

    def submit_in_between(name):
        """The first look finds nobody; then a job comes, before the dataset is out of sight."""
        if submitted:
            return store.uses_dataset(name)
        submitted.append(store.submit(train_job("one"))[0])
        return None

    submitted = []
    with pytest.raises(DatasetInUse, match="needed by the job"):
        datasets.delete("tiny", submit_in_between)
    assert datasets.get("tiny").name == "tiny"
    assert datasets.names() == ["tiny"]
    assert store.get(submitted[0].id).state is JobState.QUEUED
    store.cancel(submitted[0].id)

    submit = queue.submit

    def delete_in_between(*arguments):
        """The dataset was there when it was looked for, and is gone before a deletion could see the job."""
        datasets.delete("tiny")
        return submit(*arguments)

    monkeypatch.setattr(queue, "submit", delete_in_between)
    with pytest.raises(DatasetNotFound):
        store.submit(train_job("two"), request_id="mine")
    assert store.overview().counts[JobState.QUEUED] == 0
    assert {job.id for job in store.list()[0]} == {submitted[0].id}
