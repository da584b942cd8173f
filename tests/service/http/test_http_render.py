from __future__ import annotations

import hashlib
import io
import json
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from ultragray import GaussianScene, render
from ultragray.scene.confidence import FIGURES

from ..conftest import HEIGHT, WIDTH, RunningService

ONE_STEP = 1.001 / 255


def expected(scene: GaussianScene, poses: Any, **options: Any) -> Any:
    frames = render(scene, options.pop("probe", None), poses, height=HEIGHT, width=WIDTH, **options)
    return {name: getattr(frames, name).numpy() for name in options["outputs"]}


def post(http: httpx.Client, body: dict[str, Any], accept: str | None = None, scene: str = "demo") -> httpx.Response:
    headers = {} if accept is None else {"Accept": accept}
    return http.post(f"/v1/scenes/{scene}/render", json=body, headers=headers)


def test_raw_pixels_are_those_of_the_library(
    http: httpx.Client, demo_scene: GaussianScene, pose_body: Any, pose_matrix: Any
) -> None:
    answer = post(http, {"pose": pose_body}, "application/octet-stream")
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/octet-stream"
    assert answer.headers["x-ultragray-shape"] == f"1,1,{HEIGHT},{WIDTH}"
    assert answer.headers["x-ultragray-dtype"] == "uint8"
    frame = np.frombuffer(answer.content, np.uint8).reshape(HEIGHT, WIDTH)
    truth = expected(demo_scene, pose_matrix, outputs=("bmode",))["bmode"][0]
    assert truth.max() > 0.1
    assert np.abs(frame / 255 - truth).max() <= ONE_STEP


@pytest.mark.parametrize(
    ("accept", "extra"),
    [("application/octet-stream;dtype=float32", {}), ("application/octet-stream", {"dtype": "float32"})],
)
def test_raw_float32_holds_outputs_one_after_another(
    http: httpx.Client, demo_scene: GaussianScene, pose_body: Any, pose_matrix: Any, accept: str, extra: Any
) -> None:
    outputs = ["transmittance", "bmode"]
    answer = post(http, {"poses": [pose_body, pose_body], "outputs": outputs, **extra}, accept)
    assert answer.headers["x-ultragray-shape"] == f"2,2,{HEIGHT},{WIDTH}"
    assert answer.headers["x-ultragray-dtype"] == "float32"
    assert answer.headers["x-ultragray-outputs"] == "transmittance,bmode"
    assert "x-ultragray-pose" not in answer.headers
    data = np.frombuffer(answer.content, "<f4").reshape(2, 2, HEIGHT, WIDTH)
    truth = expected(demo_scene, np.stack([pose_matrix] * 2), outputs=outputs)
    for frames, name in zip(data, outputs, strict=True):
        np.testing.assert_allclose(frames, truth[name], atol=1e-5)


@pytest.mark.parametrize(
    ("accept", "media_type", "tolerance"), [(None, "image/png", ONE_STEP), ("image/jpeg", "image/jpeg", 0.2)]
)
def test_images(
    http: httpx.Client,
    demo_scene: GaussianScene,
    pose_body: Any,
    pose_matrix: Any,
    accept: str | None,
    media_type: str,
    tolerance: float,
) -> None:
    answer = post(http, {"pose": pose_body}, accept)
    assert answer.headers["content-type"] == media_type
    image = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
    truth = expected(demo_scene, pose_matrix, outputs=("bmode",))["bmode"][0]
    assert image.shape == truth.shape
    assert np.abs(image / 255 - truth).max() <= tolerance


def test_npz_holds_frames_poses_and_origin(
    http: httpx.Client, service: RunningService, demo_scene: GaussianScene, pose_body: Any, pose_matrix: Any
) -> None:
    answer = post(http, {"poses": [pose_body, {"matrix": np.eye(4).tolist()}], "outputs": ["bmode", "coverage"]})
    assert answer.headers["content-type"] == "application/x-npz"
    with np.load(io.BytesIO(answer.content)) as bundle:
        arrays = dict(bundle)
    assert set(arrays) == {"bmode", "coverage", "poses", *FIGURES, "scene", "scene_sha256", "renderer"}
    poses = np.stack([pose_matrix, np.eye(4)])
    np.testing.assert_array_equal(arrays["poses"], poses)
    for name, truth in expected(demo_scene, poses, outputs=("bmode", "coverage")).items():
        np.testing.assert_allclose(arrays[name], truth, atol=1e-5)
    assert str(arrays["scene"]) == "demo"
    sha256 = hashlib.sha256((service.data_folder / "demo.ugr").read_bytes()).hexdigest()
    assert str(arrays["scene_sha256"]) == answer.headers["x-ultragray-scene-sha256"] == sha256


def test_headers_let_the_frame_be_rendered_again(http: httpx.Client, pose_body: Any) -> None:
    nearly = {"position_mm": pose_body["position_mm"], "quaternion": {"w": 0.9999, "x": 0.0, "y": 0.0, "z": 0.004}}
    answer = post(http, {"pose": nearly})
    headers = answer.headers
    pose = np.array(json.loads(headers["x-ultragray-pose"]))
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
    assert json.loads(headers["x-ultragray-probe"])["kind"] == "linear"
    assert headers["x-ultragray-scene"] == "demo"
    assert headers["x-ultragray-renderer"].startswith("ultragray/")
    timings = [float(headers[f"x-ultragray-{stage}-ms"]) for stage in ("queue", "render", "encode")]
    assert min(timings) >= 0
    assert headers["server-timing"].count("dur=") == 3
    again = post(http, {"pose": {"matrix": pose.tolist()}})
    assert again.content == answer.content


def test_a_scene_without_a_probe_renders_when_one_is_given(http: httpx.Client, pose_body: Any) -> None:
    probe = {"kind": "convex", "opening_angle_deg": 60.0, "near_mm": 10.0, "far_mm": 40.0}
    assert post(http, {"pose": pose_body, "probe": probe}, scene="probeless").status_code == 200


def test_request_id_is_echoed_or_made(http: httpx.Client, pose_body: Any) -> None:
    headers = {"X-Request-Id": "robot-7.42"}
    answer = http.post("/v1/scenes/demo/render", json={"pose": pose_body}, headers=headers)
    assert answer.headers["x-request-id"] == "robot-7.42"
    assert len(post(http, {"pose": pose_body}).headers["x-request-id"]) == 32
    hostile = http.get("/v1/health/live", headers={"X-Request-Id": 'a" {injected}'})
    assert "injected" not in hostile.headers["x-request-id"]


def test_new_scene_files_appear_without_a_restart(
    http: httpx.Client, service: RunningService, demo_scene: GaussianScene, pose_body: Any
) -> None:
    path = service.data_folder / "late.ugr"
    assert post(http, {"pose": pose_body}, scene="late").status_code == 404
    demo_scene.save(path)
    try:
        assert post(http, {"pose": pose_body}, scene="late").status_code == 200
    finally:
        path.unlink()


def test_documented_examples_work(http: httpx.Client) -> None:
    document = http.get("/openapi.json").json()
    operation = document["paths"]["/v1/scenes/{scene}/render"]["post"]
    examples = operation["requestBody"]["content"]["application/json"]["examples"]
    assert len(examples) >= 3
    for example in examples.values():
        body = {"height": 16, "width": 16, **example["value"]}
        assert post(http, body).status_code == 200, example
    assert http.get("/docs").status_code == 200
