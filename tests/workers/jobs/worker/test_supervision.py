"""Jobs whose process had finished when their worker died: another worker says how they ended."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
from ultragray_workers.jobs.queue.internals import WORKFLOWS

from ultragray.phantom.demo import copy_demo_scene
from ultragray_workers.errors import JobFinished
from ultragray_workers.jobs import publication
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.folder import JobFolder, Outcome, Progress
from ultragray_workers.jobs.kinds import RenderJob
from ultragray_workers.jobs.queue import database, runs
from ultragray_workers.jobs.store import Job, JobState, JobStore
from ultragray_workers.jobs.worker import supervision
from ultragray_workers.jobs.worker.device import DeviceLock, devices_of
from ultragray_workers.jobs.worker.gate import Gate
from ultragray_workers.jobs.worker.supervision import Supervisor

from ....waiting import wait_until
from ..conftest import RunningWorker, train_job


@pytest.fixture
def finished(store: JobStore, artifact_folder: Path) -> Callable[[str], tuple[Job, JobFolder]]:
    """A queued job and its folder, as a process that was done and a worker that was killed leave it."""

    def make(scene: str) -> tuple[Job, JobFolder]:
        job, _ = store.submit(train_job(scene))
        folder = JobFolder(artifact_folder, job.id)
        folder.run.mkdir(parents=True)
        with folder.new_artifacts() as artifacts:
            (artifacts / f"{scene}.ugr").write_bytes(b"made")
        folder.write_outcome(Outcome(artifacts=folder.artifact_names(), progress=Progress(step=20, steps=20)))
        folder.reserve.touch()
        (folder.path / ".progress.json.abc.tmp").touch()
        return job, folder

    return make


def test_what_was_made_is_served_and_what_was_left_is_removed(
    store: JobStore,
    artifact_folder: Path,
    finished: Callable[[str], tuple[Job, JobFolder]],
    start_worker: Callable[..., RunningWorker],
    until: Callable[..., Job],
) -> None:
    good, folder = finished("good")
    late, _ = finished("late")
    scenes = artifact_folder / "scenes"
    scenes.mkdir()
    (scenes / "late.ugr").write_bytes(b"somebody else's")
    start_worker()

    good, late = until(good), until(late)
    assert (good.state, good.attempts, good.progress.step) == (JobState.SUCCEEDED, 1, 20), good
    assert (scenes / "good.ugr").read_bytes() == b"made"
    assert {path.name for path in folder.path.iterdir()} == {"outcome.json", "artifacts"}

    assert (late.state, late.error) == (JobState.FAILED, "SCENE_EXISTS"), late
    assert "choose another name" in (late.reason or "")
    assert store.artifact(late.id, "late.ugr").read_bytes() == b"made"
    assert (scenes / "late.ugr").read_bytes() == b"somebody else's"


@pytest.fixture
def alone(store: JobStore, artifact_folder: Path) -> Iterator[tuple[Supervisor, Callable[[str], Any]]]:
    """The supervisor, in this process, and what DBOS does: takes a job, and has it done."""
    jobs = JobDatabase(artifact_folder, None)
    folder = artifact_folder.resolve()
    gate = Gate(jobs.folder, [DeviceLock(folder, device, "me") for device in devices_of("cpu")], (), list)
    supervisor = Supervisor(supervision.WorkerConfig(folder, "me"), jobs, gate)

    def take(job_id: str) -> Outcome:
        taken = {"status": database.RUNNING[0], "executor_id": "me"}
        with jobs.engine.begin() as connection:
            connection.execute(sa.update(WORKFLOWS).where(WORKFLOWS.c.workflow_uuid == job_id).values(**taken))
        row = jobs.workflow(job_id, with_input=True)
        assert row is not None
        assert row.input is not None
        return supervisor.supervise(job_id, row.input["args"][0])

    yield supervisor, take
    jobs.close()


Alone = tuple[Supervisor, Callable[[str], Outcome]]


def test_a_cancellation_while_the_scene_is_published_is_refused(
    store: JobStore,
    artifact_folder: Path,
    finished: Callable[[str], tuple[Job, JobFolder]],
    alone: Alone,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    job, _ = finished("late")

    def publish(*arguments: Any) -> None:
        with pytest.raises(JobFinished, match="being served"):
            store.cancel(job.id)
        publication.publish_scene(*arguments)
        with pytest.raises(JobFinished, match="being served"):
            store.cancel(job.id)

    monkeypatch.setattr(supervision, "publish_scene", publish)
    assert alone[1](job.id).error is None
    assert (artifact_folder / "scenes" / "late.ugr").read_bytes() == b"made"
    assert store.get(job.id).state is JobState.RUNNING  # DBOS writes the end


@pytest.mark.long
def test_a_cancellation_that_comes_first_serves_nothing(
    store: JobStore,
    artifact_folder: Path,
    finished: Callable[[str], tuple[Job, JobFolder]],
    alone: Alone,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also where whoever cancelled died before the queue knew of it."""
    job, _ = finished("late")
    assert runs.decide(store.database.engine, job.id, runs.CANCELLED)
    with pytest.raises(supervision.Interrupted):
        alone[1](job.id)
    assert not (artifact_folder / "scenes" / "late.ugr").exists()
    assert store.get(job.id).state is JobState.CANCELLED
    assert store.retry(job.id)[1]


@pytest.mark.long
def test_the_result_of_a_lost_database_is_not_the_result_of_another_request(
    store: JobStore, artifact_folder: Path, tmp_path: Path, start_worker: Callable[..., RunningWorker]
) -> None:
    """The issue's own case: four frames are asked for, where a folder holds the two of an earlier request."""
    (artifact_folder / "scenes").mkdir()
    copy_demo_scene(artifact_folder / "scenes" / "demo.ugr")

    def asked(count: int) -> RenderJob:
        return RenderJob(scene="demo", poses=np.tile(np.eye(4), (count, 1, 1)), height=16, width=16)

    def done(store: JobStore, count: int) -> Job:
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
    with np.load(fresh.artifact(second.id, "frames.npz")) as archive:
        assert len(archive["poses"]) == 4
    assert fresh.log_tail(second.id).count("rendering") == 1
    fresh.close()
