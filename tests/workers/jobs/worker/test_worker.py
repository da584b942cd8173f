"""Jobs done by real workers, which are killed, stopped and replaced."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from ultragray.datasets.source import load_dataset
from ultragray.learn.training import TrainingConfig, train
from ultragray.samplers import AroundSampler
from ultragray.scene.gaussians import GaussianScene
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import JobFinished, JobNotFinished, StartupFailed
from ultragray_workers.jobs.kinds import RenderJob
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.worker.worker import claim_name

from ....waiting import at_this_load
from ..conftest import files_of, path_of, store_dataset, train_job


def is_training(job):
    return job.state is JobState.RUNNING and (job.progress.step or 0) > 0


@pytest.mark.long
def test_good_jobs_run_in_order_and_bad_ones_fail_with_a_reason(store, artifact_folder, tmp_path, start_worker, until):
    poisoned = store_dataset(artifact_folder, "poisoned") / "poses_train.npy"
    poses = np.load(poisoned)
    poses[1, 0, 3] = np.nan
    np.save(poisoned, poses)
    last, _ = store.submit(train_job("good"), priority=-5)
    store_dataset(artifact_folder, "gone")
    deleted, _ = store.submit(train_job("deleted", dataset="gone"))
    first, _ = store.submit(train_job("poisoned", dataset="poisoned"), priority=5)
    DatasetStore(artifact_folder).delete("gone")
    worker = start_worker()

    last = until(last)
    assert last.state is JobState.SUCCEEDED, last
    jobs = [store.get(job.id) for job in (first, deleted, last)]
    assert [job.finished_at for job in jobs] == sorted(job.finished_at or "" for job in jobs)
    assert [(job.state, job.error) for job in jobs[:2]] == [
        (JobState.FAILED, "DATASET_INVALID"),
        (JobState.FAILED, "DATASET_NOT_FOUND"),
    ]
    reasons = [job.reason or "" for job in jobs[:2]]
    assert "frame 1" in reasons[0]
    assert "'gone'" in reasons[1]
    assert not any(str(artifact_folder) in reason for reason in reasons)
    assert "failed: " in store.log_tail(first.id)

    assert (last.progress.step, last.progress.steps, last.attempts, last.worker) == (20, 20, 1, "one")
    assert last.metrics["psnr_db"] > 5
    served = artifact_folder / "scenes" / "good.ugr"
    assert path_of(store.artifact(last.id, "good.ugr")).read_bytes() == served.read_bytes()
    assert {"metrics.json", "metrics.jsonl", "training_curve.png", "report.html"} < set(last.artifacts)
    report = path_of(store.artifact(last.id, "report.html")).read_text()
    assert "<dt>Scene</dt><dd>good</dd>" in report
    assert f"{last.metrics['psnr_db']:.2f} ±" in report
    assert report.count("<img ") == 2 * 5  # both held-out frames, with all panels
    for name in last.artifacts:
        if name.endswith(".png"):
            assert path_of(store.artifact(last.id, name)).read_bytes().startswith(b"\x89PNG")
    assert list((artifact_folder / "work").iterdir()) == []
    with pytest.raises(JobFinished):
        store.cancel(last.id)
    with pytest.raises(JobNotFinished):
        store.retry(last.id)

    render, _ = store.submit(RenderJob(scene="good", sampler=AroundSampler(40, 1.0, 1.0), height=20, width=24))
    render = until(render)
    assert render.state is JobState.SUCCEEDED, render
    assert (render.progress.frames_done, render.progress.frames, render.artifacts) == (40, 40, ("frames.npz",))
    with np.load(path_of(store.artifact(render.id, "frames.npz"))) as archive:
        assert archive["bmode"].shape == (40, 20, 24)
        assert archive["bmode"].max() > 0
    assert worker.terminate() == 0
    assert (tmp_path / "one.log").read_text() == ""  # jobs that fail are ordinary


def test_name_of_a_worker_is_its_alone(tmp_path):
    with pytest.raises(StartupFailed, match="name must be"), claim_name(tmp_path, "a/b"):
        pass
    program = (
        f"import sys; sys.path[:] = {sys.path!r}\nfrom pathlib import Path\n"
        "from ultragray_workers.jobs.worker.worker import claim_name\n"
        f"with claim_name(Path({str(tmp_path)!r}), None) as name: print(name[-2:])\n"
        f"with claim_name(Path({str(tmp_path)!r}), 'mine'): pass"
    )
    with claim_name(tmp_path, None) as name, claim_name(tmp_path, "mine"):
        assert name.endswith("-0")
        told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert told.stdout.strip() == "-1"
    assert "another worker is called 'mine'" in told.stderr
    with claim_name(tmp_path, "mine"):
        pass


@pytest.mark.long
def test_cancelled_within_a_second_and_retried_from_its_checkpoint(store, artifact_folder, start_worker, until):
    worker = start_worker()
    job, _ = store.submit(train_job("one", steps=1_000_000))
    until(job, is_training)
    killed = worker.job_process()
    assert killed is not None
    os.kill(killed, signal.SIGTERM)  # leaves a checkpoint
    until(job, lambda job: worker.job_process() not in (None, killed) and "from a checkpoint" in store.log_tail(job.id))
    process = worker.job_process()
    assert process is not None

    cancelled_at = time.monotonic()
    assert store.cancel(job.id).state is JobState.CANCELLED
    while Path(f"/proc/{process}").exists():
        assert time.monotonic() - cancelled_at < at_this_load(1.0)
        time.sleep(0.01)
    assert not (artifact_folder / "scenes" / "one.ugr").exists()

    successor, _ = store.retry(job.id)
    until(successor, is_training)
    assert "going on from a checkpoint" in store.log_tail(successor.id)
    store.cancel(successor.id)
    assert store.get(job.id).state is JobState.CANCELLED


def test_process_that_dies_again_and_again_is_given_up(store, start_worker, until):
    job, _ = store.submit(train_job("one", steps=1_000_000))
    worker = start_worker()
    ended = set()
    while store.get(job.id).state in (JobState.QUEUED, JobState.RUNNING):
        process = worker.job_process()
        if process is not None and process not in ended:
            ended.add(process)
            os.kill(process, signal.SIGSEGV)
        time.sleep(0.05)
    job = store.get(job.id)
    assert (job.state, job.error) == (JobState.FAILED, "INTERNAL")
    assert "3 times" in (job.reason or "")
    assert "SIGSEGV" in (job.reason or "")
    assert len(ended) == 3


@pytest.mark.long
@pytest.mark.slow
def test_killed_worker_is_replaced_and_the_scene_is_that_of_an_undisturbed_run(
    store, artifact_folder, tmp_path, start_worker, until
):
    asked = train_job("one", steps=800)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    config = TrainingConfig.preset("fast", **asked.settings)
    undisturbed = train(load_dataset(files_of(artifact_folder, "tiny")), config)
    torch.set_num_threads(threads)

    one = start_worker("one")
    job, _ = store.submit(asked)
    until(job, is_training)
    assert one.terminate() == 0  # writes a checkpoint and puts the job back
    job = store.get(job.id)
    assert job.state is JobState.QUEUED
    with store.files.checkpoint(job.id) as checkpoint:
        assert checkpoint is not None

    two = start_worker("two")
    process = until(job, lambda job: is_training(job) and two.job_process() is not None) and two.job_process()
    two.kill()
    assert store.get(job.id).state is JobState.RUNNING  # nobody has noticed
    three = start_worker("three")
    job = until(job)
    assert (job.state, job.worker, job.attempts) == (JobState.SUCCEEDED, "three", 3), job
    assert not Path(f"/proc/{process}").exists()
    assert "going on from a checkpoint" in store.log_tail(job.id)
    made = GaussianScene.load(path_of(store.artifact(job.id, "one.ugr")))
    for name, tensor in undisturbed.splats.items():
        assert torch.equal(made.splats[name], tensor), name
    steps = [line.count('"step"') for line in path_of(store.artifact(job.id, "metrics.jsonl")).read_text().splitlines()]
    assert steps == [1] * 800
    assert three.terminate() == 0
