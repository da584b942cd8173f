"""Scenes, datasets and jobs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ultragray.installation import memory_bytes
from ultragray_client import (
    AroundSampler,
    Box,
    ConvexProbe,
    DatasetOptions,
    Display,
    JobState,
    LinearProbe,
    Needle,
    RenderJob,
    ToolFrame,
    TrainJob,
    WorkerState,
    errors,
)

from ..service.conftest import RunningService
from ..service.http.test_http_datasets import poisoned_files, released_files
from ..waiting import wait_until

SETTINGS = {"steps": 20, "max_gaussians": 40, "batch_size": 2}


@pytest.fixture(scope="module")
def client_service(working_service: RunningService) -> RunningService:
    """One with a worker."""
    return working_service


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    released_files(tmp_path / "tiny")
    return tmp_path / "tiny"


@pytest.fixture
def name(request: pytest.FixtureRequest) -> str:
    """Of its own for each test."""
    return str(request.node.name).translate(str.maketrans("[]", "--"))


def test_scenes(client: Any) -> None:
    entries = {entry.name: entry for entry in client.scenes.list()}
    assert {"demo", "second", "probeless", "truncated", "foreign", "empty"} <= set(entries)
    assert entries["demo"].error is None
    assert entries["demo"].gaussian_count == 400
    assert "truncated" in (entries["truncated"].error or "")
    scene = client.scenes.get("demo")
    assert (scene.gaussian_count, scene.centre_mm, scene.probe) == (400, (0.0, 0.0, 20.0), LinearProbe(40.0, 0.0, 40.0))
    assert (scene.training_pose_count, scene.training_position_max_mm) == (5, (0.0, 4.0, 0.0))
    assert [pose[1, 3] for pose in scene.training_poses] == [0.0, 2.0, 4.0]
    assert scene.metrics == {"psnr": 20.5}
    assert client.scenes.get("probeless").probe is None
    assert client.scenes.load("demo") == 1
    assert client.scenes.get("demo").loaded_processes == 1
    assert client.scenes.unload("demo") == 0
    with pytest.raises(errors.SceneNotFound):
        client.scenes.get("gone")


def test_the_life_of_a_dataset(client: Any, folder: Path, name: str) -> None:
    made = client.datasets.upload(name, folder, options=DatasetOptions(train_frames="0:6"))
    assert (made.name, made.kind, made.train_frames, made.val_frames) == (name, "released", 6, 3)
    assert (made.probe, made.options) == (LinearProbe(40.0, 0.0, 50.0), {"train_frames": "0:6"})
    assert client.datasets.get(name) == made
    assert made in client.datasets.list()
    assert client.datasets.contact_sheet(name).startswith(b"\x89PNG")
    assert client.datasets.upload(name, folder, options=DatasetOptions(train_frames="0:6")) == made
    with pytest.raises(errors.DatasetExists):
        client.datasets.upload(name, folder)
    client.datasets.delete(name)
    with pytest.raises(errors.DatasetNotFound):
        client.datasets.delete(name)


def test_uploads_that_are_refused(client: Any, folder: Path, name: str, tmp_path: Path) -> None:
    for path in (tmp_path / "gone", folder / "conf.json"):
        with pytest.raises(errors.InvalidArgument, match="folder or an archive"):
            client.datasets.upload(name, path)
    for file, content in poisoned_files({path.name: path.read_bytes() for path in folder.iterdir()}).items():
        (folder / file).write_bytes(content)
    with pytest.raises(errors.DatasetInvalid, match=r"poses_train\.npy"):
        client.datasets.upload(name, folder)


def test_the_life_of_a_training(client: Any, folder: Path, name: str, tmp_path: Path) -> None:
    client.datasets.upload(name, folder)
    job = client.jobs.submit(TrainJob(name, f"{name}.scene", settings=SETTINGS, device="cpu"), request_id=name)
    assert (job.kind, job.specification.settings, job.request_id) == ("train", SETTINGS, name)
    again = client.jobs.submit(TrainJob(name, f"{name}.scene", settings=SETTINGS, device="cpu"), request_id=name)
    assert again.id == job.id
    with pytest.raises(errors.RequestIdConflict):
        client.jobs.submit(TrainJob(name, f"{name}.other", settings=SETTINGS, device="cpu"), request_id=name)
    events = list(client.jobs.watch(job.id))
    done = [event.job for event in events if event.job][-1]
    assert (done.state, done.progress.step, done.error) == (JobState.SUCCEEDED, 20, None)
    assert done.state.final
    assert done == client.jobs.wait(job.id) == client.jobs.get(job.id)
    assert done in client.jobs.list(state="succeeded", kind="train")
    assert len(client.jobs.list(limit=1)) == 1
    assert isinstance(client.jobs.log(job.id), str)

    client.jobs.download(job.id, "metrics.json", tmp_path / "metrics.json")
    assert json.loads((tmp_path / "metrics.json").read_text())
    client.jobs.download(job.id, f"{name}.scene.ugr", tmp_path / "scene.ugr")
    assert (tmp_path / "scene.ugr").stat().st_size == client.scenes.get(f"{name}.scene").file_bytes
    with pytest.raises(errors.ArtifactNotFound):
        client.jobs.download(job.id, "gone", tmp_path / "gone")
    assert {path.name for path in tmp_path.iterdir()} == {"tiny", "metrics.json", "scene.ugr"}

    with pytest.raises(errors.JobFinished):
        client.jobs.cancel(job.id)
    with pytest.raises(errors.JobNotFinished):
        client.jobs.retry(job.id)
    client.jobs.delete(job.id)
    with pytest.raises(errors.JobNotFound):
        client.jobs.get(job.id)


def test_a_batch_of_frames_as_a_job(client: Any, tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    job = client.jobs.submit(
        RenderJob(scene="demo", poses=poses, height=8, width=6, outputs=("bmode", "echo"), dtype="uint8")
    )
    assert (job.pose_count, job.specification.outputs) == (3, ("bmode", "echo"))
    assert client.jobs.wait(job.id).state is JobState.SUCCEEDED
    client.jobs.download(job.id, "frames.npz", tmp_path / "frames.npz")
    with np.load(tmp_path / "frames.npz") as frames:
        assert frames["echo"].shape == (3, 8, 6)
    shown = RenderJob(
        scene="demo",
        poses=poses,
        height=8,
        width=6,
        probe=ConvexProbe(60.0, 5.0, 40.0),
        display=Display(pixel_mm=0.5),
        tools=(
            Needle(tip_mm=(1.0, 0.0, 20.0), hub_mm=(-9.0, 0.0, 5.0), frame=ToolFrame.PROBE, opacity=0.0),
            Box(centre_mm=(0.0, 0.0, 30.0), size_mm=(4.0, 4.0, 2.0), label=4),
        ),
        ghost=0.5,
    )
    again = client.jobs.submit(shown)
    assert again.specification == replace(shown, poses=None, format="npz")
    assert again.request_id != job.request_id != ""
    with pytest.raises(errors.InvalidArgument, match="count"):
        client.jobs.submit(RenderJob(scene="demo", sampler=AroundSampler(count=0)))
    with pytest.raises(errors.UnknownOutput, match="shadow"):
        client.jobs.submit(RenderJob(scene="demo", poses=poses, outputs=("shadow",)))
    with pytest.raises(errors.InvalidPose, match=r"poses\[1\] must be"):
        client.jobs.submit(RenderJob(scene="demo", poses=[np.eye(4), np.eye(3)]))
    with pytest.raises(errors.InvalidArgument, match="state must be one of queued"):
        client.jobs.list(state="lost")


def test_cancel_and_retry(client: Any) -> None:
    poses = np.tile(np.eye(4), (20_000, 1, 1))
    job = client.jobs.submit(RenderJob(scene="demo", poses=poses, height=300, width=300), priority=-5)
    cancelled = client.jobs.cancel(job.id)
    assert client.jobs.wait(job.id).state is JobState.CANCELLED
    assert client.jobs.cancel(job.id).state is JobState.CANCELLED
    again = client.jobs.retry(job.id)
    assert (again.retry_of, again.id != cancelled.id) == (job.id, True)
    with pytest.raises(errors.JobInUse):
        client.jobs.delete(again.id)
    client.jobs.cancel(again.id)
    client.jobs.wait(again.id)


def test_workers_rest_and_resume(client: Any) -> None:
    (worker,) = wait_until(lambda: [one for one in client.workers.list() if one.state is WorkerState.IDLE])
    assert (worker.pid > 0, worker.device) == (True, "auto")
    try:
        (device,) = [one for one in worker.devices if one.name == "cpu"]
        assert device.memory_bytes == memory_bytes()
        assert worker.labels == {}
        assert client.workers.drain(worker.name).state is WorkerState.DRAINED
        assert client.workers.pause(worker.name).state is WorkerState.PAUSED
        assert client.workers.list()[0].state is WorkerState.PAUSED
    finally:
        assert client.workers.resume(worker.name).state in (WorkerState.IDLE, WorkerState.WORKING)
    with pytest.raises(errors.WorkerNotFound, match="there is no worker 'gone'"):
        client.workers.pause("gone")
