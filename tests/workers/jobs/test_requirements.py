"""Render jobs that could not be done are refused; the scene of the others is kept as it is."""

import errno

import numpy as np
import pytest

from ultragray import GaussianScene, LinearProbe
from ultragray.errors import InvalidArgument, InvalidImageSize, InvalidProbe, LowConfidence, UnknownOutput
from ultragray.samplers import AroundSampler, SplineSampler, TrainingSampler
from ultragray.scene.confidence import ConfidenceModel
from ultragray_workers.errors import DatabaseUnavailable, SceneNotFound, StorageFull
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.kinds import RenderJob, TrainJob, render, train
from ultragray_workers.jobs.kinds.base import Surroundings
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.scenes import SceneStore
from ultragray_workers.storage import local

INFO = {"probe": LinearProbe(30.0, 0.0, 40.0), "image_height": 24, "image_width": 20}
POSES = np.tile(np.eye(4), (3, 1, 1))
MODEL = ConfidenceModel((3.5, 1.2, 0.8, 0.1, 0.6), 0.06, (0.0,) * 3, 20, 0.04).to_dict()


@pytest.fixture
def save(tmp_path, random_scene):
    """Serves a scene and returns its file's content."""

    def make(name, seed=0, **changes):
        made = random_scene(20, seed=seed, info=INFO | changes)
        scene = GaussianScene.from_splats(made.splats, info=made.info, training_poses=POSES)
        scene.save(tmp_path / f"{name}.ugr")
        return (tmp_path / f"{name}.ugr").read_bytes()

    return make


@pytest.fixture
def scenes(tmp_path):
    return SceneStore(tmp_path)


@pytest.fixture
def rendering_store(artifact_folder, scenes):
    return JobStore(artifact_folder, None, scenes=scenes, max_image_side=64)


def kept(artifact_folder, job_id):
    folder = artifact_folder / "jobs" / job_id
    assert [path.name for path in folder.iterdir()] == ["one.ugr"]
    return (folder / "one.ugr").read_bytes()


@pytest.mark.parametrize(
    ("job", "error"),
    [
        (RenderJob(scene="one", sampler=TrainingSampler(), height=65), InvalidImageSize),
        (RenderJob(scene="one", sampler=TrainingSampler(), outputs=("labels",)), UnknownOutput),
        (RenderJob(scene="one", poses=POSES, sampler=SplineSampler(count=3)), InvalidArgument),
        (RenderJob(scene="probeless", sampler=TrainingSampler()), InvalidProbe),
        (RenderJob(scene="none", sampler=TrainingSampler()), SceneNotFound),
    ],
)
def test_refused(job, error, save, rendering_store):
    save("one")
    save("probeless", probe=None)
    with pytest.raises(error):
        rendering_store.submit(job)
    assert rendering_store.list() == ([], None)
    rendering_store.close()


@pytest.mark.parametrize(
    ("job", "needed_bytes"),
    [
        (RenderJob(scene="one", poses=POSES), 3 * 24 * 20 * 4),
        (
            RenderJob(scene="one", poses=POSES, outputs=("bmode", "echo"), dtype="uint8", height=10, width=64),
            3 * 10 * 64 * 2,
        ),
        (RenderJob(scene="one", sampler=AroundSampler(50), format="dicom"), 50 * 24 * 20),
    ],
)
def test_room_for_all_pixels(job, needed_bytes, save, scenes):
    save("one")
    job.check(Surroundings(scenes.header("one"), needed_bytes, 64))
    job.check(Surroundings(scenes.header("one"), None, 64))
    with pytest.raises(StorageFull, match=r"frames of .* take up to .* left"):
        job.check(Surroundings(scenes.header("one"), needed_bytes - 1, 64))


def test_given_poses_are_assessed_where_that_is_quick(save, scenes, monkeypatch):
    def check(job):
        job.check(Surroundings(scenes.header(job.scene), None, 64))

    save("one", confidence=MODEL)
    save("plain")
    far = POSES.copy()
    far[2, 1, 3] = 30.0
    check(RenderJob(scene="one", poses=POSES, min_confidence=0.5))
    with pytest.raises(LowConfidence, match=r"poses\[2\] has a confidence of"):
        check(RenderJob(scene="one", poses=far, min_confidence=0.5))
    check(RenderJob(scene="one", poses=far, sampler=AroundSampler(5), min_confidence=0.5))
    with pytest.raises(InvalidArgument, match="needs a scene that knows"):
        check(RenderJob(scene="plain", poses=POSES, min_confidence=0.5))
    monkeypatch.setattr(render, "ASSESSED_AT_ONCE", 8)
    check(RenderJob(scene="one", poses=far, min_confidence=0.5))


def test_submission_sent_again_after_a_failure_takes_the_scene_of_now(
    save, rendering_store, artifact_folder, monkeypatch
):
    def away(*arguments, **options):
        raise DatabaseUnavailable("away")

    save("one", seed=1)
    with monkeypatch.context() as context:
        context.setattr(queue, "submit", away)
        with pytest.raises(DatabaseUnavailable):
            rendering_store.submit(RenderJob(scene="one", poses=POSES), request_id="mine")
    now = save("one", seed=2)
    job, _ = rendering_store.submit(RenderJob(scene="one", poses=POSES), request_id="mine")
    assert kept(artifact_folder, job.id) == now
    rendering_store.close()


def test_retry_takes_the_scene_of_the_job_before(save, rendering_store, artifact_folder, tmp_path):
    then = save("one", seed=1)
    job, _ = rendering_store.submit(RenderJob(scene="one", poses=POSES))
    rendering_store.cancel(job.id)
    save("one", seed=2)
    successor, _ = rendering_store.retry(job.id)
    assert kept(artifact_folder, successor.id) == then
    (tmp_path / "one.ugr").unlink()
    rendering_store.cancel(successor.id)
    last, _ = rendering_store.retry(successor.id)
    assert kept(artifact_folder, last.id) == then
    rendering_store.close()


def test_scene_that_goes_meanwhile_and_a_disk_that_is_full(save, rendering_store, tmp_path, monkeypatch):
    save("one")

    def gone(source, target):
        source.unlink()
        raise FileNotFoundError(errno.ENOENT, "gone")

    def full(source, target):
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(local, "link_or_copy", full)
    with pytest.raises(StorageFull, match="no room for the scene"):
        rendering_store.submit(RenderJob(scene="one", poses=POSES))
    monkeypatch.setattr(local, "link_or_copy", gone)
    with pytest.raises(SceneNotFound):
        rendering_store.submit(RenderJob(scene="one", poses=POSES))
    assert not (tmp_path / "one.ugr").exists()
    rendering_store.close()


def test_a_training_may_not_have_more_memory_than_the_host(tmp_path, monkeypatch):
    monkeypatch.setattr(train, "memory_bytes", lambda: 8 << 30)

    def check(device, memory_gb):
        TrainJob("liver", "new", settings={"memory_gb": memory_gb}, device=device).check(
            Surroundings(None, tmp_path, 512)
        )

    for device in ("cpu", "auto"):
        with pytest.raises(
            InvalidArgument, match=r"memory_gb must be at most the 8\.0 GiB of the host, got 8\.5"
        ) as told:
            check(device, 8.5)
        assert told.value.field == "settings.memory_gb"
        check(device, 8.0)
        check(device, None)
    check("cuda:0", 80.0)  # of the GPU, which the worker knows
