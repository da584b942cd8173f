"""Render jobs in shards, made by real workers that are killed on the way."""

import numpy as np
import pytest
import sqlalchemy as sa

from ultragray.phantom.demo import copy_demo_scene
from ultragray.samplers import AroundSampler
from ultragray.scene.info import read_header
from ultragray_workers.jobs.kinds import RenderJob
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.tables import JOBS, SHARDS

from .conftest import train_job

SEED = 11


@pytest.fixture
def scene(artifact_folder):
    path = artifact_folder / "scenes" / "spine.ugr"
    path.parent.mkdir()
    copy_demo_scene(path)
    return path


def batch(count, shard_frames, **settings):
    size = {"height": 16, "width": 12} | settings
    return RenderJob(scene="spine", sampler=AroundSampler(count, seed=SEED), shard_frames=shard_frames, **size)


def is_under_way(job):
    return (job.progress.frames_done or 0) > 0


@pytest.mark.long
def test_a_shard_that_cannot_be_made_fails_the_job_which_names_it_and_a_retry_goes_on(
    store, scene, start_worker, until
):
    poses = np.tile(read_header(scene).training_poses, (6, 1, 1))  # too many to look at each when they are submitted
    poses[1000, :3, 3] += 500.0
    job = RenderJob(scene="spine", poses=poses, shard_frames=300, height=16, width=12, min_confidence=0.5)
    submitted, _ = store.submit(job)
    start_worker()
    failed = until(submitted)
    assert (failed.state, failed.error) == (JobState.FAILED, "LOW_CONFIDENCE")
    assert (failed.reason or "").startswith("shard 3 (frames 900 to 1,199): poses[1000] has a confidence of 0."), failed
    folder = scene.parents[1] / "jobs" / failed.id / "batch"
    made = {path.name: path.stat().st_ino for path in folder.glob("*.tar")}
    assert sorted(made) == ["frames-000000.tar", "frames-000001.tar", "frames-000002.tar"]

    again, _ = store.retry(failed.id)
    assert until(again).error == "LOW_CONFIDENCE"
    taken = scene.parents[1] / "jobs" / again.id / "batch"
    assert {path.name: path.stat().st_ino for path in taken.glob("*.tar")} == made


@pytest.mark.long
def test_cancelling_ends_the_batch_and_its_shares(store, scene, start_worker, until):
    job, _ = store.submit(batch(3_000_000, None))
    assert job.specification["format"] == "tar"
    workers = [start_worker(name, host=name) for name in ("one", "two")]
    until(job, is_under_way)
    until(job, lambda _: all(worker.job_process() for worker in workers))
    until(job, lambda _: {worker.job for worker in store.workers()} == {job.id})
    store.cancel(job.id)
    until(job, lambda _: not any(worker.job_process() for worker in workers), timeout_s=20)
    with store.database.engine.connect() as connection:
        left = connection.execute(sa.select(JOBS.c.state).distinct()).scalars().all()
    assert left == ["cancelled"]
    store.delete(job.id)
    with store.database.engine.connect() as connection:
        for table in (SHARDS, JOBS):
            assert connection.execute(sa.select(sa.func.count()).select_from(table)).scalar() == 0


@pytest.mark.long
def test_a_share_leaves_its_worker_to_other_jobs(store, scene, start_worker, until):
    job, _ = store.submit(batch(500_000, 50))
    workers = [start_worker(name, host=name, longest_share_s=0.5) for name in ("one", "two")]
    until(job, lambda _: all(worker.job_process() for worker in workers))
    other, _ = store.submit(train_job("other"))
    assert until(other).state is JobState.SUCCEEDED
    assert store.get(job.id).state is JobState.RUNNING
    store.cancel(job.id)
