"""The store without a worker: jobs stay queued."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest

from ultragray.errors import InvalidArgument
from ultragray.samplers import TrainingSampler
from ultragray_workers.errors import (
    ArtifactNotFound,
    DatasetNotFound,
    JobConflict,
    JobNotFinished,
    JobNotFound,
    JobQueueFull,
    SceneExists,
    SceneNotFound,
    StartupFailed,
)
from ultragray_workers.jobs.kinds import RenderJob
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.scenes import SceneStore

from .conftest import train_job

TRAINING_POSES = TrainingSampler()


@pytest.fixture
def database_url(new_database):
    return new_database()


def test_submitted_job_waits(store):
    job, is_new = store.submit(train_job("one"), priority=5)
    assert is_new
    assert job.state is JobState.QUEUED
    assert (job.kind, job.priority, job.attempts, job.worker, job.started_at) == ("train", 5, 0, None, None)
    assert job.specification["dataset"] == "tiny"
    assert job.specification["settings"]["steps"] == 20
    assert store.get(job.id) == job
    assert store.log_tail(job.id) == ""


def test_same_request_id_gives_the_same_job(store):
    job, _ = store.submit(train_job("one"), request_id="mine")
    assert store.submit(train_job("one"), request_id="mine") == (job, False)
    otherwise = train_job("one")
    other_order = replace(otherwise, settings=dict(reversed(otherwise.settings.items())))  # as another door has it
    assert store.submit(other_order, request_id="mine") == (job, False)
    store.cancel(job.id)
    assert store.submit(train_job("one"), request_id="mine") == (store.get(job.id), False)
    for other in (train_job("two"), RenderJob(scene="one", sampler=TRAINING_POSES)):
        with pytest.raises(JobConflict, match="'mine'"):
            store.submit(other, request_id="mine")
    with pytest.raises(JobConflict):
        store.submit(train_job("one"), request_id="mine", priority=1)
    with pytest.raises(InvalidArgument, match="128"):
        store.submit(train_job("one"), request_id="x" * 129)


def test_a_request_id_is_its_owners(store):
    mine, _ = store.submit(train_job("one"), request_id="mine", owner="alice")
    others, is_new = store.submit(train_job("two"), request_id="mine", owner="bob")
    assert is_new
    assert store.submit(train_job("two"), request_id="mine", owner="bob") == (others, False)
    assert store.submit(train_job("one"), request_id="mine", owner="alice") == (mine, False)


@pytest.mark.parametrize("request_id", ["a\0b", "\0", "half a character: \ud800"])
def test_request_id_that_no_database_keeps_is_refused(store, request_id):
    with pytest.raises(InvalidArgument, match="NUL") as caught:
        store.submit(train_job("one"), request_id=request_id)
    assert caught.value.field == "request_id"
    assert store.list() == ([], None)


def test_submitted_by_two_services_at_once(store, artifact_folder, database_url):
    other = JobStore(artifact_folder, database_url)
    with ThreadPoolExecutor(8) as threads:
        answers = list(
            threads.map(lambda number: (store, other)[number % 2].submit(train_job("one"), request_id="mine"), range(8))
        )
    other.close()
    assert len({job.id for job, _ in answers}) == 1
    assert sum(is_new for _, is_new in answers) == 1


def test_refused_at_once(store, artifact_folder):
    with pytest.raises(DatasetNotFound):
        store.submit(train_job("one", dataset="none"))
    with pytest.raises(SceneNotFound):
        store.submit(RenderJob(scene="one", sampler=TRAINING_POSES))
    store.submit(train_job("one"))
    with pytest.raises(SceneExists, match="another job"):
        store.submit(train_job("one"))
    (artifact_folder / "scenes").mkdir()
    (artifact_folder / "scenes" / "two.ugr").touch()
    with pytest.raises(SceneExists, match="already a scene"):
        store.submit(train_job("two"))
    with pytest.raises(InvalidArgument, match="priority"):
        store.submit(train_job("three"), priority=1001)


def test_scene_name_is_free_again_after_cancelling(store):
    job, _ = store.submit(train_job("one"))
    store.cancel(job.id)
    assert store.submit(train_job("one"))[1]


def test_scenes_of_the_service_may_be_rendered_and_not_replaced(artifact_folder, tmp_path, database_url):
    from ultragray.phantom.demo import copy_demo_scene

    (tmp_path / "data").mkdir()
    copy_demo_scene(tmp_path / "data" / "demo.ugr")
    store = JobStore(artifact_folder, database_url, scenes=SceneStore(tmp_path / "data"))
    job, _ = store.submit(RenderJob(scene="demo", sampler=TRAINING_POSES))
    kept = artifact_folder / "jobs" / job.id / "demo.ugr"
    assert kept.read_bytes() == (tmp_path / "data" / "demo.ugr").read_bytes()
    with pytest.raises(SceneExists):
        store.submit(train_job("demo"))
    store.close()


def test_queue_limit(artifact_folder, database_url):
    store = JobStore(artifact_folder, database_url, queue_limit=2)
    first, _ = store.submit(train_job("one"), request_id="first")
    store.submit(train_job("two"))
    with pytest.raises(JobQueueFull):
        store.submit(train_job("three"))
    assert store.submit(train_job("one"), request_id="first")[0] == first
    store.cancel(first.id)
    store.submit(train_job("three"))
    store.close()


def test_pages_newest_first(store):
    made = [store.submit(train_job(f"scene-{number}"))[0].id for number in range(7)]
    store.cancel(made[3])
    found = []
    token = None
    sizes = []
    while True:
        jobs, token = store.list(page_size=3, page_token=token)
        found += [job.id for job in jobs]
        sizes.append(len(jobs))
        store.submit(train_job(f"later-{len(sizes)}"))  # moves nothing
        if token is None:
            break
    assert found == made[::-1]
    assert sizes == [3, 3, 1]
    assert [job.id for job in store.list(state=JobState.CANCELLED)[0]] == [made[3]]
    assert len(store.list(state=JobState.QUEUED)[0]) == 9
    assert store.list(kind="render") == ([], None)
    assert store.list(state=JobState.RUNNING) == ([], None)
    for token in ("x", "bm90aGluZw==", "WzEsIDJd"):
        with pytest.raises(InvalidArgument, match="page_token"):
            store.list(page_token=token)


def test_cancel_and_retry(store):
    job, _ = store.submit(train_job("one"), priority=3, request_id="mine")
    with pytest.raises(JobNotFinished, match="queued"):
        store.retry(job.id)
    cancelled = store.cancel(job.id)
    assert cancelled.state is JobState.CANCELLED
    assert cancelled.finished_at is not None
    assert store.cancel(job.id) == cancelled
    successor, is_new = store.retry(job.id)
    assert (successor.retry_of, successor.state, successor.priority) == (job.id, JobState.QUEUED, 3)
    assert successor.specification == job.specification
    assert successor.request_id is None
    assert is_new
    assert store.retry(job.id) == (successor, False)


def test_unknown_jobs(store):
    for job_id in ("0" * 24, "../datasets", ""):
        for call in (store.get, store.cancel, store.retry, store.log_tail):
            with pytest.raises(JobNotFound):
                call(job_id)
        with pytest.raises(JobNotFound):
            store.artifact(job_id, "a")
    job, _ = store.submit(train_job("one"))
    with pytest.raises(ArtifactNotFound):
        store.artifact(job.id, "../job.json")


def test_dataset_in_use(store):
    assert store.uses_dataset("tiny") is None
    job, _ = store.submit(train_job("one"))
    assert store.uses_dataset("tiny") == f"the job {job.id}"
    assert store.uses_dataset("other") is None
    store.cancel(job.id)
    assert store.uses_dataset("tiny") is None


def test_database_that_cannot_be_reached_is_told_without_the_password(tmp_path):
    with pytest.raises(StartupFailed, match="database") as caught:
        JobStore(tmp_path, "postgresql://me:secret@127.0.0.1:1/jobs")
    assert "secret" not in str(caught.value)
