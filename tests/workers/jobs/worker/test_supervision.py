"""Jobs whose process had finished when their worker died: another worker says how they ended."""

import hashlib

import numpy as np
import pytest

from ultragray.phantom.demo import copy_demo_scene
from ultragray_workers.errors import JobFinished
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.kinds import RenderJob
from ultragray_workers.jobs.progress import JobState, Outcome, Progress
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.jobs.worker import supervision
from ultragray_workers.jobs.worker.device import DeviceLock, Gate, devices_of
from ultragray_workers.jobs.worker.supervision import Supervisor
from ultragray_workers.scene_shelf import SceneShelf
from ultragray_workers.storage.local import LocalStorage

from ....waiting import wait_until
from ..conftest import path_of, request_of, train_job


@pytest.fixture
def finished(store, artifact_folder):
    """A job and its folder, as a process that was done and a worker of this host that was killed leave it."""

    def make(scene, **told):
        job, _ = store.submit(train_job(scene), priority=len(store.list()[0]))  # it goes first
        row = queue.take(store.database.engine, "dead", queue.demands_waiting(store.database.engine))
        queue.put_back(store.database.engine, row)
        folder = JobFolder(artifact_folder, job.id, row.attempt)
        folder.run.mkdir(parents=True)
        folder.write_request(request_of({}, artifact_folder, row.number))
        with folder.new_artifacts() as artifacts:
            (artifacts / f"{scene}.ugr").write_bytes(b"made")
        outcome = Outcome(artifacts=folder.artifact_names(), progress=Progress(step=20, steps=20), **told)
        folder.write_outcome(outcome)
        folder.reserve.touch()
        (folder.path / ".progress.json.abc.tmp").touch()
        return job, folder

    return make


def test_what_was_made_is_served_and_what_was_left_is_removed(store, artifact_folder, finished, start_worker, until):
    good, folder = finished("good")
    late, _ = finished("late", sha256={"late.ugr": "hashed while it was written"})
    scenes = artifact_folder / "scenes"
    scenes.mkdir()
    (scenes / "late.ugr").write_bytes(b"somebody else's")
    start_worker()

    good, late = until(good), until(late)
    assert (good.state, good.attempts, good.progress.step) == (JobState.SUCCEEDED, 2, 20), good
    assert (scenes / "good.ugr").read_bytes() == b"made"
    assert list(folder.path.parent.iterdir()) == []

    assert (late.state, late.error) == (JobState.FAILED, "SCENE_EXISTS"), late
    assert "choose another name" in (late.reason or "")
    assert path_of(store.artifact(late.id, "late.ugr")).read_bytes() == b"made"
    named = {job.id: queue.row_of(store.database.engine, job.id).files.artifacts for job in (good, late)}
    assert named[good.id]["good.ugr"].sha256 == hashlib.sha256(b"made").hexdigest()
    assert named[late.id]["late.ugr"].sha256 == "hashed while it was written"  # it is not read again
    assert (scenes / "late.ugr").read_bytes() == b"somebody else's"


@pytest.fixture
def alone(store, artifact_folder, monkeypatch):
    """Takes a job whose process had finished and says how it ended, in this process; its row as it was taken."""

    def start(*_):
        raise AssertionError("what is done is not done again")

    monkeypatch.setattr(supervision, "job_process", start)
    jobs = JobDatabase(artifact_folder, None)
    folder = artifact_folder.resolve()
    gate = Gate(jobs.identity, [DeviceLock(folder, device, "me") for device in devices_of("cpu")], (), list)
    supervisor = Supervisor(supervision.WorkerConfig(folder, LocalStorage(folder), threads=1), jobs, gate)

    def do():
        row = queue.take(jobs.engine, "me", queue.demands_waiting(jobs.engine))
        supervisor.supervise(row)
        return row

    yield do
    jobs.close()


def test_a_cancellation_while_the_scene_is_published_is_refused(store, artifact_folder, finished, alone, monkeypatch):
    job, _ = finished("late")
    published = SceneShelf.publish

    def publish(*arguments):
        with pytest.raises(JobFinished, match="being served"):
            store.cancel(job.id)
        published(*arguments)
        with pytest.raises(JobFinished, match="being served"):
            store.cancel(job.id)

    monkeypatch.setattr(SceneShelf, "publish", publish)
    alone()
    assert (artifact_folder / "scenes" / "late.ugr").read_bytes() == b"made"
    assert store.get(job.id).state is JobState.SUCCEEDED


def test_a_cancellation_that_comes_first_serves_nothing(store, artifact_folder, finished, alone, monkeypatch):
    job, _ = finished("late")
    publish = queue.publish

    def cancelled_first(*arguments):
        store.cancel(job.id)
        return publish(*arguments)

    monkeypatch.setattr(queue, "publish", cancelled_first)
    alone()
    assert not (artifact_folder / "scenes" / "late.ugr").exists()
    assert store.get(job.id).state is JobState.CANCELLED
    assert store.retry(job.id)[1]


def test_a_worker_that_died_while_it_served_the_scene_is_followed_by_one_that_serves_it(
    store, artifact_folder, finished, alone, monkeypatch
):
    """On another host, which has nothing but the record and the objects that it names."""
    job, _ = finished("late")

    class DiedError(BaseException):
        pass

    def die(*_):
        raise DiedError

    with monkeypatch.context() as patched:
        patched.setattr(SceneShelf, "publish", die)
        with pytest.raises(DiedError):
            alone()
    engine = store.database.engine
    assert queue.put_back_of(engine) == [job.id]
    with pytest.raises(JobFinished, match="being served"):
        store.cancel(job.id)
    assert list((artifact_folder / "work").iterdir()) == []
    alone()
    assert (artifact_folder / "scenes" / "late.ugr").read_bytes() == b"made"
    assert (store.get(job.id).state, store.get(job.id).attempts) == (JobState.SUCCEEDED, 3)


@pytest.mark.long
def test_the_result_of_a_lost_database_is_not_the_result_of_another_request(
    store, artifact_folder, tmp_path, start_worker
):
    """The issue's own case: four frames are asked for, where a folder holds the two of an earlier request."""
    (artifact_folder / "scenes").mkdir()
    copy_demo_scene(artifact_folder / "scenes" / "demo.ugr")

    def asked(count):
        return RenderJob(scene="demo", poses=np.tile(np.eye(4), (count, 1, 1)), height=16, width=16)

    def done(store, count):
        worker = start_worker()
        job, is_new = store.submit(asked(count), request_id="mine")
        assert is_new
        wait_until(lambda: store.get(job.id).state.is_final)
        worker.kill()
        return store.get(job.id)

    first = done(store, 2)
    assert first.state is JobState.SUCCEEDED, first
    store.close()
    for file in artifact_folder.glob("jobs.sqlite*"):
        file.unlink()
    fresh = JobStore(artifact_folder, None)
    second = done(fresh, 4)
    assert second.id == first.id
    assert (second.state, second.progress.frames_done) == (JobState.SUCCEEDED, 4), second
    with np.load(path_of(fresh.artifact(second.id, "frames.npz"))) as archive:
        assert len(archive["poses"]) == 4
    assert fresh.log_tail(second.id).count("rendering") == 1
    fresh.close()
