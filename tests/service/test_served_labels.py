"""Labels and phased probes through both front doors: a service of its own, with a scene that carries labels."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import cv2
import grpc
import httpx
import numpy as np
import numpy.typing as npt
import pytest
import torch

from ultragray import GaussianScene, PhasedProbe, Probe, RadialProbe, SceneInfo, SteeredProbe, render
from ultragray.contract import to_dict
from ultragray_proto.v1 import geometry_pb2, rendering_pb2, rendering_pb2_grpc, scenes_pb2, scenes_pb2_grpc

from .conftest import DEMO_PROBE, RunningService, StartService, make_scene

NAMES = {1: "bone", 200: "vessel"}
PHASED = PhasedProbe(opening_angle_deg=80.0, far_mm=40.0)
PHASED_BODY = {"kind": "phased", "opening_angle_deg": 80.0, "far_mm": 40.0}
HEIGHT, WIDTH = 40, 30
TIMEOUT_S = 120
RAW = "application/octet-stream"

Labels = npt.NDArray[np.uint8]


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    plain = make_scene(probe=DEMO_PROBE)
    labels = torch.tensor([0, 1, 200, 200], dtype=torch.uint8).repeat(100)
    info = SceneInfo(centre_mm=plain.info.centre_mm, probe=PHASED, label_names=NAMES)
    return GaussianScene.from_splats(plain.splats, info=info, labels=labels, training_poses=plain.training_poses)


@pytest.fixture(scope="module")
def labelled_service(
    start_service: StartService, tmp_path_factory: pytest.TempPathFactory, scene: GaussianScene
) -> RunningService:
    folder = tmp_path_factory.mktemp("labelled")
    scene.save(folder / "labelled.ugr")
    make_scene(20, probe=DEMO_PROBE).save(folder / "plain.ugr")
    return start_service(data_folder=folder)


@pytest.fixture(scope="module")
def client(labelled_service: RunningService) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=labelled_service.http, timeout=TIMEOUT_S) as client:
        yield client


@pytest.fixture(scope="module")
def grpc_channel(labelled_service: RunningService) -> Iterator[grpc.Channel]:
    with labelled_service.channel() as channel:
        yield channel


@pytest.fixture(scope="module")
def truth(scene: GaussianScene) -> Labels:  # [H, W]
    labels = render(scene, None, np.eye(4), height=HEIGHT, width=WIDTH, outputs=("labels",)).labels
    assert labels is not None
    assert {*labels.unique().tolist()} == {0, 1, 200}
    found: Labels = labels[0].numpy()
    return found


def post(client: httpx.Client, accept: str, *, scene: str = "labelled", **changes: Any) -> httpx.Response:
    pose = {"matrix": np.eye(4).tolist()}
    body = {"height": HEIGHT, "width": WIDTH, "outputs": ["labels"], "pose": pose, **changes}
    if "poses" in body:
        del body["pose"]
    return client.post(f"/v1/scenes/{scene}/render", json=body, headers={"Accept": accept})


def ask(channel: grpc.Channel, encoding: int, *, scene: str = "labelled", **changes: Any) -> rendering_pb2.Frame:
    settings: dict[str, Any] = {"outputs": [rendering_pb2.OUTPUT_LABELS], **changes}
    pose = geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=np.eye(4).ravel().tolist()))
    request = rendering_pb2.RenderRequest(
        settings=rendering_pb2.RenderSettings(scene=scene, height=HEIGHT, width=WIDTH, encoding=encoding, **settings),
        pose=pose,
    )
    frame: rendering_pb2.Frame = rendering_pb2_grpc.RenderServiceStub(channel).Render(request, timeout=TIMEOUT_S)
    return frame


def test_http_gives_the_labels_themselves(client: httpx.Client, truth: Labels) -> None:
    raw = post(client, RAW)
    assert raw.headers["x-ultragray-outputs"] == "labels"
    np.testing.assert_array_equal(np.frombuffer(raw.content, np.uint8).reshape(HEIGHT, WIDTH), truth)
    floats = post(client, f"{RAW};dtype=float32")
    np.testing.assert_array_equal(np.frombuffer(floats.content, "<f4").reshape(HEIGHT, WIDTH), truth)
    image = post(client, "image/jpeg, image/*;q=0.5")  # jpeg would change them
    assert image.headers["content-type"] == "image/png"
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(image.content, np.uint8), cv2.IMREAD_UNCHANGED), truth)


@pytest.mark.parametrize("count", [2, 40])  # in one part, and in several that are packed together
def test_an_npz_holds_them_as_uint8(client: httpx.Client, truth: Labels, count: int) -> None:
    poses = [{"matrix": np.eye(4).tolist()}] * count
    answer = post(client, "application/x-npz", poses=poses, outputs=["bmode", "labels"])
    with np.load(io.BytesIO(answer.content)) as bundle:
        assert (bundle["labels"].dtype, bundle["bmode"].dtype) == (np.uint8, np.float32)
        np.testing.assert_array_equal(bundle["labels"], np.stack([truth] * count))


def test_raw_labels_lie_beside_other_outputs(client: httpx.Client, scene: GaussianScene, truth: Labels) -> None:
    answer = post(client, RAW, outputs=["labels", "coverage"])
    labels, coverage = np.frombuffer(answer.content, np.uint8).reshape(2, HEIGHT, WIDTH)
    np.testing.assert_array_equal(labels, truth)
    expected = render(scene, None, np.eye(4), height=HEIGHT, width=WIDTH, outputs=("coverage",)).coverage
    assert expected is not None
    np.testing.assert_allclose(coverage / 255, expected[0], atol=1.001 / 255)


def test_grpc_gives_the_labels_themselves(grpc_channel: grpc.Channel, truth: Labels) -> None:
    raw = ask(grpc_channel, rendering_pb2.ENCODING_UINT8)
    assert list(raw.outputs) == [rendering_pb2.OUTPUT_LABELS]
    np.testing.assert_array_equal(np.frombuffer(raw.data, np.uint8).reshape(HEIGHT, WIDTH), truth)
    floats = ask(grpc_channel, rendering_pb2.ENCODING_FLOAT32)
    np.testing.assert_array_equal(np.frombuffer(floats.data, "<f4").reshape(HEIGHT, WIDTH), truth)
    image = ask(grpc_channel, rendering_pb2.ENCODING_PNG)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_UNCHANGED), truth)


def test_jpeg_is_refused(client: httpx.Client, grpc_channel: grpc.Channel) -> None:
    answer = post(client, "image/jpeg")
    assert (answer.status_code, answer.json()["reason"]) == (406, "NOT_ACCEPTABLE")
    with pytest.raises(grpc.RpcError, match="encoding jpeg would change labels") as caught:
        ask(grpc_channel, rendering_pb2.ENCODING_JPEG)
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT


def test_a_scene_without_labels_refuses_them(client: httpx.Client, grpc_channel: grpc.Channel) -> None:
    answer = post(client, RAW, scene="plain")
    problem = answer.json()
    assert (answer.status_code, problem["reason"], problem["field"]) == (422, "UNKNOWN_OUTPUT", "outputs")
    assert "carry labels" in problem["detail"]
    with pytest.raises(grpc.RpcError, match="carry labels") as caught:
        ask(grpc_channel, rendering_pb2.ENCODING_UINT8, scene="plain")
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT


def test_a_scene_tells_its_names_and_its_phased_probe(client: httpx.Client, grpc_channel: grpc.Channel) -> None:
    answer = client.get("/v1/scenes/labelled").json()
    assert answer["label_names"] == {"1": "bone", "200": "vessel"}
    assert answer["probe"] == PHASED_BODY
    assert client.get("/v1/scenes/plain").json()["label_names"] == {}
    stub = scenes_pb2_grpc.SceneServiceStub(grpc_channel)
    message = stub.GetScene(scenes_pb2.GetSceneRequest(scene="labelled"), timeout=TIMEOUT_S)
    assert dict(message.label_names) == NAMES
    assert message.probe == geometry_pb2.Probe(phased=geometry_pb2.PhasedProbe(opening_angle_deg=80.0, far_mm=40.0))


@pytest.mark.parametrize(
    "asked",
    [PHASED, RadialProbe(near_mm=1.0, far_mm=30.0), SteeredProbe(40.0, 25.0, near_mm=0.0, far_mm=40.0)],
    ids=lambda asked: asked.kind,
)
def test_another_probe_may_be_asked_for(asked: Probe, client: httpx.Client, grpc_channel: grpc.Channel) -> None:
    plain = make_scene(20, probe=DEMO_PROBE)
    frames = render(plain, asked, np.eye(4), height=HEIGHT, width=WIDTH, outputs=("bmode",))
    assert frames.bmode is not None
    over_http = post(client, f"{RAW};dtype=float32", scene="plain", outputs=["bmode"], probe=to_dict(asked))
    pixels = np.frombuffer(over_http.content, "<f4").reshape(HEIGHT, WIDTH)
    assert pixels.max() > 0.05
    np.testing.assert_allclose(pixels, frames.bmode[0], atol=1e-5)
    numbers = {name: value for name, value in to_dict(asked).items() if name != "kind"}
    probe = geometry_pb2.Probe(**{asked.kind: numbers})
    outputs = [rendering_pb2.OUTPUT_BMODE]
    frame = ask(grpc_channel, rendering_pb2.ENCODING_FLOAT32, scene="plain", outputs=outputs, probe=probe)
    assert frame.probe == probe
    np.testing.assert_allclose(np.frombuffer(frame.data, "<f4").reshape(HEIGHT, WIDTH), pixels, atol=1e-6)


def test_a_phased_probe_that_cannot_be_is_named(client: httpx.Client, grpc_channel: grpc.Channel) -> None:
    problem = post(client, RAW, outputs=["bmode"], probe={**PHASED_BODY, "far_mm": 0.0}).json()
    assert (problem["reason"], problem["field"]) == ("INVALID_PROBE", "probe.far_mm")
    problem = post(client, RAW, outputs=["bmode"], probe={**PHASED_BODY, "near_mm": 0.0}).json()
    assert problem["field"] == "probe.near_mm"
    probe = geometry_pb2.Probe(phased=geometry_pb2.PhasedProbe(opening_angle_deg=80.0))
    with pytest.raises(grpc.RpcError, match=r"probe\.phased\.far_mm"):
        ask(grpc_channel, rendering_pb2.ENCODING_UINT8, probe=probe)
