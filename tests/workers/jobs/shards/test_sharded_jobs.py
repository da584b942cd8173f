"""Render jobs in shards, made by real workers that are killed on the way."""

from __future__ import annotations

import hashlib
import io
import json
import tarfile

import numpy as np
import pytest
import sqlalchemy as sa

from ultragray import render
from ultragray.phantom.demo import copy_demo_scene
from ultragray.samplers import AroundSampler
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import read_header
from ultragray_workers.jobs.kinds import RenderJob
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.tables import JOBS, SHARDS

from ..conftest import path_of, train_job

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


def pixels_of(store, job):
    """The pixels of each frame by its key, of all shards; each key once."""
    manifest = json.loads(path_of(store.artifact(job.id, "manifest.json")).read_text())
    found = {}
    for shard in manifest["shards"]:
        path = path_of(store.artifact(job.id, shard["file"]))
        assert path.stat().st_size == shard["bytes"]
        assert hashlib.sha256(path.read_bytes()).hexdigest() == shard["sha256"]
        with tarfile.open(path) as tar:
            for name in tar.getnames():
                key, _, suffix = name.partition(".")
                if suffix == "bmode.npy":
                    assert key not in found
                    member = tar.extractfile(name)
                    found[key] = np.load(io.BytesIO(member.read())).tobytes()
    return found


def is_under_way(job):
    return (job.progress.frames_done or 0) > 0


@pytest.mark.long
def test_a_batch_goes_on_without_the_workers_that_die_and_has_each_frame_once(store, scene, start_worker, until):
    count = 5_100
    job, _ = store.submit(batch(count, 250))
    workers = {name: start_worker(name, host=name) for name in ("one", "two")}
    job = until(job, is_under_way)
    until(job, lambda _: all(worker.job_process() for worker in workers.values()))
    workers[job.worker or ""].kill()  # the one that has the batch itself
    workers["third"] = start_worker("third", host="third")
    job = until(job, lambda one: one.attempts > 1 and one.state is JobState.RUNNING)
    helper = next(name for name in workers if name != job.worker and workers[name].process.poll() is None)
    workers[helper].kill()
    job = until(job)
    assert job.state is JobState.SUCCEEDED, job
    assert job.artifacts == ("manifest.json", "frames-{000000..000020}.tar")
    assert (job.progress.frames_done, job.progress.frames) == (count, count)
    assert [one.id for one in store.list()[0]] == [job.id]  # nobody sees the shares
    found = pixels_of(store, job)
    assert sorted(found) == [f"{number:06d}" for number in range(count)]
    loaded = GaussianScene.load(scene)
    poses = AroundSampler(count, seed=SEED).poses(loaded.training_poses, loaded.info.probe_or(None))
    chosen = np.random.default_rng(0).integers(0, count, 40)
    frames = render(loaded, None, poses[chosen], height=16, width=12, outputs=("bmode",))["bmode"].numpy()
    for number, frame in zip(chosen, frames, strict=True):
        assert found[f"{number:06d}"] == np.rint(frame * 255).astype(np.uint8).tobytes()

    store.delete(job.id)
    assert not list((scene.parents[1] / "jobs").glob("[0-9a-f]*"))
    with store.database.engine.connect() as connection:
        assert connection.execute(sa.select(sa.func.count()).select_from(SHARDS)).scalar() == 0
        assert connection.execute(sa.select(sa.func.count()).select_from(JOBS)).scalar() == 0


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


@pytest.mark.long
def test_a_share_leaves_its_worker_to_other_jobs(store, scene, start_worker, until):
    job, _ = store.submit(batch(500_000, 50))
    workers = [start_worker(name, host=name, longest_share_s=0.5) for name in ("one", "two")]
    until(job, lambda _: all(worker.job_process() for worker in workers))
    other, _ = store.submit(train_job("other"))
    assert until(other).state is JobState.SUCCEEDED
    assert store.get(job.id).state is JobState.RUNNING
    store.cancel(job.id)
