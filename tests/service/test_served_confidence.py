"""What frames tell of their extrapolation, and what is done with those far away, through each front door."""

import json
import shutil
from dataclasses import replace

import grpc
import numpy as np
import pytest

from ultragray import render
from ultragray.rendering.confidence import supported_shares
from ultragray.scene.confidence import Assessor, ConfidenceModel, Support
from ultragray_proto.v1 import geometry_pb2, rendering_pb2, rendering_pb2_grpc

from .conftest import HEIGHT, WIDTH

MODEL = ConfidenceModel((3.5, 1.2, 0.8, 0.1, 0.6), 0.06, (0.0,) * 5, 20, 0.04)
NEAR, FAR = 2.0, 20.0  # of the training views from 0 to 4 mm in elevation


def at(y):  # [4, 4] mm
    pose = np.eye(4)
    pose[1, 3] = y
    return pose


def body(*elevations_mm, **fields):
    poses = [{"matrix": at(y).tolist()} for y in elevations_mm]
    return {"pose": poses[0], **fields} if len(poses) == 1 else {"poses": poses, **fields}


@pytest.fixture(scope="module")
def knowing(demo_scene):
    return replace(demo_scene, info=replace(demo_scene.info, confidence=MODEL.to_dict()))


@pytest.fixture(scope="module")
def service(start_service, knowing, data_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("knowing")
    knowing.save(folder / "knowing.ugr")
    coverage = render(knowing, None, at(NEAR), height=HEIGHT, width=WIDTH, outputs=("coverage",))["coverage"]
    gain = 0.35 / float(supported_shares(coverage))
    thin = replace(MODEL, support=Support(gain, share=1.0 / gain, reach_mm=10.0))
    replace(knowing, info=replace(knowing.info, confidence=thin.to_dict())).save(folder / "thin.ugr")
    shutil.copy(data_folder / "demo.ugr", folder)
    return start_service(data_folder=folder, artifact_folder=tmp_path_factory.mktemp("artifacts"))


def test_a_frame_tells_what_the_library_says(http, knowing):
    answer = http.post("/v1/scenes/knowing/render", json=body(NEAR))
    told = json.loads(answer.headers["X-Ultragray-Extrapolation"])
    coverage = render(knowing, None, at(NEAR), height=HEIGHT, width=WIDTH, outputs=("coverage",)).coverage
    (expected,) = Assessor(knowing.info, knowing.training_poses).assess(at(NEAR), coverage=coverage.numpy())
    assert told == pytest.approx(vars(expected))
    assert 0 < told["supported_share"] < 1
    assert float(answer.headers["X-Ultragray-Confidence"]) == pytest.approx(told["confidence"], abs=6e-4)


def test_a_scene_that_cannot_tell_says_so(http):
    answer = http.post("/v1/scenes/demo/render", json=body(NEAR))
    told = json.loads(answer.headers["X-Ultragray-Extrapolation"])
    assert told["confidence"] is None
    assert told["distance_mm"] == pytest.approx(0.0, abs=1e-6)
    assert answer.headers["X-Ultragray-Confidence"] == ""
    refusal = http.post("/v1/scenes/demo/render", json=body(NEAR, min_confidence=0.5)).json()
    assert (refusal["reason"], refusal["field"]) == ("INVALID_ARGUMENT", "min_confidence")


def test_poses_below_the_limit_are_refused(http):
    assert http.post("/v1/scenes/knowing/render", json=body(NEAR, min_confidence=0.5)).status_code == 200
    answer = http.post("/v1/scenes/knowing/render", json=body(FAR, min_confidence=0.5))
    assert answer.status_code == 422
    assert answer.json()["reason"] == "LOW_CONFIDENCE"
    assert "16.0 mm" in answer.json()["detail"]
    many = http.post("/v1/scenes/knowing/render", json=body(NEAR, NEAR, FAR, min_confidence=0.5)).json()
    assert (many["reason"], many["field"]) == ("LOW_CONFIDENCE", "poses[2]")
    assert (
        http.post("/v1/scenes/knowing/render", json=body(FAR, min_confidence=1.5)).json()["field"] == "min_confidence"
    )


def test_so_are_frames_that_turn_out_below_it(http):
    """The pose alone suffices; the Gaussians support too little of its frame."""
    told = http.post("/v1/scenes/thin/render", json=body(NEAR, min_confidence=0.3))
    confidence = float(told.headers["X-Ultragray-Confidence"])
    assert 0.3 < confidence < 0.5
    answer = http.post("/v1/scenes/thin/render", json=body(NEAR, NEAR, min_confidence=0.5))
    assert (answer.status_code, answer.json()["reason"], answer.json()["field"]) == (422, "LOW_CONFIDENCE", "poses[0]")
    assert "Gaussians support" in answer.json()["detail"]
    fields = {"outputs": ["bmode", "coverage"], "dtype": "float32", "min_confidence": 0.5}
    masked = http.post("/v1/scenes/thin/render", json=body(NEAR, below_min_confidence="mask", **fields))
    bmode, coverage = np.frombuffer(masked.content, "<f4").reshape(2, HEIGHT, WIDTH)
    assert 0.0 < (coverage < 0.3).mean() < 1.0
    assert (bmode[coverage < 0.3] == 0).all()


def test_grpc(service):
    settings = rendering_pb2.RenderSettings(scene="knowing", min_confidence=0.5)

    def pose(y):
        return geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=at(y).ravel().tolist()))

    with service.channel() as channel:
        stub = rendering_pb2_grpc.RenderServiceStub(channel)
        frame = stub.Render(rendering_pb2.RenderRequest(settings=settings, pose=pose(NEAR)))
        assert 0.5 < frame.extrapolation.confidence <= 1
        assert frame.extrapolation.HasField("supported_share")
        with pytest.raises(grpc.RpcError, match="confidence"):
            stub.Render(rendering_pb2.RenderRequest(settings=settings, pose=pose(FAR)))
        settings.below_min_confidence = rendering_pb2.BELOW_CONFIDENCE_MASK
        masked = stub.Render(rendering_pb2.RenderRequest(settings=settings, pose=pose(FAR)))
        assert masked.extrapolation.confidence < 0.5
        settings.below_min_confidence = 7
        with pytest.raises(grpc.RpcError, match="BELOW_CONFIDENCE_MASK"):
            stub.Render(rendering_pb2.RenderRequest(settings=settings, pose=pose(NEAR)))
