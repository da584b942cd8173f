"""Jobs whose process had finished when their worker died: another worker says how they ended."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from ultragray_workers.jobs import publication
from ultragray_workers.jobs.folder import JobFolder, Outcome, Progress
from ultragray_workers.jobs.queue import database
from ultragray_workers.jobs.queue.database import JobDatabase
from ultragray_workers.jobs.queue.internals import WORKFLOWS
from ultragray_workers.jobs.store import Job, JobState, JobStore
from ultragray_workers.jobs.worker import supervision

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


def test_scene_of_a_job_cancelled_at_the_last_moment_is_not_served(
    store: JobStore,
    artifact_folder: Path,
    finished: Callable[[str], tuple[Job, JobFolder]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The supervisor alone, in this process, as DBOS calls it."""
    job, _ = finished("late")
    jobs = JobDatabase(artifact_folder, None)
    rows = WORKFLOWS
    taken = {"status": database.RUNNING[0], "executor_id": "me"}
    with jobs.engine.begin() as connection:
        connection.execute(sa.update(rows).where(rows.c.workflow_uuid == job.id).values(**taken))

    def publish(*arguments: Any) -> None:
        publication.publish_scene(*arguments)
        assert (artifact_folder / "scenes" / "late.ugr").exists()
        store.cancel(job.id)

    monkeypatch.setattr(supervision, "publish_scene", publish)
    supervisor = supervision.Supervisor(supervision.WorkerConfig(artifact_folder, "me"), jobs)
    request = {"specification": {"kind": "train", "scene": "late"}, "retry_of": None}
    with pytest.raises(supervision.Interrupted):
        supervisor.supervise(job.id, request)
    assert not (artifact_folder / "scenes" / "late.ugr").exists()
    assert store.get(job.id).state is JobState.CANCELLED
    jobs.close()
