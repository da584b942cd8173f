"""How far frames extrapolate, and what becomes of those far away."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ultragray import GaussianScene, render
from ultragray.scene.confidence import Assessor
from ultragray_client import (
    AroundSampler,
    Below,
    ConfidenceFit,
    Encoding,
    Extrapolation,
    RenderJob,
    RenderSettings,
    errors,
)

from ..service.conftest import HEIGHT, WIDTH, RunningService, StartService
from ..service.test_served_confidence import BESIDE, FAR, MODEL, NEAR, at


@pytest.fixture(scope="module")
def knowing(demo_scene: GaussianScene) -> GaussianScene:
    return replace(demo_scene, info=replace(demo_scene.info, confidence=MODEL.to_dict()))


@pytest.fixture(scope="module")
def knowing_service(
    start_service: StartService, knowing: GaussianScene, data_folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> RunningService:
    folder = tmp_path_factory.mktemp("knowing")
    knowing.save(folder / "knowing.ugr")
    shutil.copy(data_folder / "demo.ugr", folder)
    return start_service(
        data_folder=folder,
        artifact_folder=tmp_path_factory.mktemp("artifacts"),
        max_poses_per_request=4,
        embedded_worker=True,
    )


@pytest.fixture
def client(make_client: Any, knowing_service: RunningService) -> Any:
    return make_client(knowing_service.grpc, timeout_s=60.0)


def test_a_frame_tells_what_the_library_says(client: Any, knowing: GaussianScene) -> None:
    told = client.render("knowing", at(NEAR)).extrapolation
    coverage = render(knowing, None, at(NEAR), height=HEIGHT, width=WIDTH, outputs=("coverage",)).coverage
    assert coverage is not None
    (expected,) = Assessor(knowing.info, knowing.training_poses).assess(at(NEAR), coverage=coverage.numpy())
    assert isinstance(told, Extrapolation)
    assert vars(told) == pytest.approx(vars(expected))


def test_what_a_scene_cannot_tell_is_none(client: Any) -> None:
    told = client.render("demo", at(FAR)).extrapolation
    assert told.confidence is None
    assert told.distance_mm > 10.0
    with pytest.raises(errors.InvalidArgument) as caught:
        client.render("demo", at(FAR), RenderSettings(min_confidence=0.5))
    assert caught.value.field == "settings.min_confidence"


def test_a_scene_tells_how_well_it_knows(client: Any) -> None:
    assert client.scenes.get("knowing").confidence == ConfidenceFit(error=MODEL.error, fitted_on=MODEL.fitted_on)
    assert client.scenes.get("demo").confidence is None


def test_a_pose_below_the_limit_is_refused(client: Any) -> None:
    assert client.render("knowing", at(NEAR), RenderSettings(min_confidence=0.5)).extrapolation.confidence > 0.5
    with pytest.raises(errors.LowConfidence, match=r"16\.0 mm") as caught:
        client.render("knowing", at(FAR), RenderSettings(min_confidence=0.5))
    assert caught.value.field == "pose"


def test_in_a_batch_by_its_place_in_the_whole(client: Any) -> None:
    """In the third of its calls, after some frames."""
    poses = np.stack([at(NEAR)] * 10 + [at(FAR)] + [at(NEAR)])
    frames = client.render_batch("knowing", poses, RenderSettings(min_confidence=0.5, height=8, width=8))
    assert [next(frames).sequence for _ in range(10)] == list(range(10))
    with pytest.raises(errors.LowConfidence, match=r"poses\[10\] has a confidence") as caught:
        next(frames)
    assert caught.value.field == "poses[10]"


def test_in_a_stream_in_place_of_its_frame(client: Any) -> None:
    with client.stream("knowing", RenderSettings(min_confidence=0.5, height=8, width=8)) as stream:
        far = stream.send(at(FAR))
        near = stream.send(at(NEAR))
        with pytest.raises(errors.LowConfidence) as caught:
            stream.receive()
        assert (caught.value.sequence, stream.receive().sequence) == (far, near)


def test_or_its_pixels_without_support_are_masked(client: Any) -> None:
    frame = client.render(
        "knowing",
        at(BESIDE),
        RenderSettings(
            min_confidence=0.93,
            below_min_confidence=Below.MASK,
            outputs=("bmode", "coverage"),
            encoding=Encoding.FLOAT32,
        ),
    )
    assert frame.extrapolation.confidence < 0.93
    supported = frame["coverage"] >= 0.3
    assert supported.mean() == pytest.approx(frame.extrapolation.supported_share)
    whole = client.render("knowing", at(BESIDE), RenderSettings(encoding=Encoding.FLOAT32))["bmode"]
    assert whole[~supported].max() > 0.0
    np.testing.assert_array_equal(frame["bmode"], np.where(supported, whole, 0.0))


def test_another_word_is_refused(client: Any) -> None:
    with pytest.raises(errors.InvalidArgument, match="refuse, mask, got 'drop'") as caught:
        client.render("knowing", at(NEAR), RenderSettings(min_confidence=0.5, below_min_confidence="drop"))
    assert caught.value.field == "below_min_confidence"
    with pytest.raises(errors.InvalidArgument) as caught:
        client.render("knowing", at(NEAR), RenderSettings(min_confidence=1.5))
    assert caught.value.field == "settings.min_confidence"


def test_jobs_keep_within_it(client: Any, tmp_path: Path) -> None:
    with pytest.raises(errors.LowConfidence, match=r"poses\[1\]"):
        client.jobs.submit(RenderJob(scene="knowing", poses=[at(NEAR), at(FAR)], min_confidence=0.5))
    sampler = AroundSampler(count=4, translation_mm=3.0)
    job = client.jobs.submit(RenderJob(scene="knowing", sampler=sampler, min_confidence=0.93, height=8, width=8))
    assert job.specification.min_confidence == 0.93
    client.jobs.wait(job.id)
    client.jobs.download(job.id, "frames.npz", tmp_path / "frames.npz")
    with np.load(tmp_path / "frames.npz") as archive:
        assert archive["confidence"].shape == (4,)
        assert archive["confidence"].min() >= 0.93
