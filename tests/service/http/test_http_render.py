"""Scenes and their frames over HTTP: every form of an answer, and what it tells."""

import base64
import hashlib
import io
import json
import math
import re
from datetime import datetime

import cv2
import httpx
import numpy as np
import pydicom
import pytest
from PIL import Image
from pydicom.uid import UltrasoundImageStorage

from ultragray import render
from ultragray.scene.confidence import FIGURES

from ..conftest import HEIGHT, WIDTH

ONE_STEP = 1.001 / 255


def expected(scene, poses, **options):
    frames = render(scene, options.pop("probe", None), poses, height=HEIGHT, width=WIDTH, **options)
    return {name: getattr(frames, name).numpy() for name in options["outputs"]}


def post(http, body, accept=None, scene="demo"):
    headers = {} if accept is None else {"Accept": accept}
    return http.post(f"/v1/scenes/{scene}/render", json=body, headers=headers)


def test_raw_float32_holds_outputs_one_after_another(http, demo_scene, pose_body, pose_matrix):
    outputs = ["transmittance", "bmode"]
    body = {"poses": [pose_body, pose_body], "outputs": outputs}
    answer = post(http, body, "application/octet-stream;dtype=float32")
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
def test_images(http, demo_scene, pose_body, pose_matrix, accept, media_type, tolerance):
    answer = post(http, {"pose": pose_body}, accept)
    assert answer.headers["content-type"] == media_type
    image = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
    truth = expected(demo_scene, pose_matrix, outputs=("bmode",))["bmode"][0]
    assert image.shape == truth.shape
    assert np.abs(image / 255 - truth).max() <= tolerance


def test_npz_holds_frames_poses_and_origin(http, service, demo_scene, pose_body, pose_matrix):
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


def test_headers_tell_the_pose_as_it_was_rendered_and_the_times(http, pose_body):
    nearly = {"position_mm": pose_body["position_mm"], "quaternion": {"w": 0.9999, "x": 0.0, "y": 0.0, "z": 0.004}}
    headers = post(http, {"pose": nearly}).headers
    pose = np.array(json.loads(headers["x-ultragray-pose"]))
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
    assert min(float(headers[f"x-ultragray-{stage}-ms"]) for stage in ("queue", "render", "encode")) >= 0
    assert headers["server-timing"].count("dur=") == 3


def test_a_scene_without_a_probe_renders_when_one_is_given(http, pose_body):
    probe = {"kind": "convex", "opening_angle_deg": 60.0, "near_mm": 10.0, "far_mm": 40.0}
    assert post(http, {"pose": pose_body, "probe": probe}, scene="probeless").status_code == 200


def test_a_probe_may_be_given_by_name(http, pose_body):
    named, spelled_out = (
        post(http, {"pose": pose_body, "probe": probe}, "image/png")
        for probe in ("L12-4", {"kind": "linear", "width_mm": 38.0, "near_mm": 0.0, "far_mm": 60.0})
    )
    assert (named.status_code, named.content) == (200, spelled_out.content)
    assert json.loads(named.headers["x-ultragray-probe"])["width_mm"] == 38.0
    for probe in ("L12-5", 3):
        refused = post(http, {"pose": pose_body, "probe": probe})
        assert (refused.status_code, refused.json()["field"], refused.json()["reason"]) == (
            422,
            "probe",
            "INVALID_PROBE",
        )
        assert "got" in refused.json()["detail"]


def test_request_id_is_echoed_or_made(http, pose_body):
    headers = {"X-Request-Id": "robot-7.42"}
    answer = http.post("/v1/scenes/demo/render", json={"pose": pose_body}, headers=headers)
    assert answer.headers["x-request-id"] == "robot-7.42"
    assert len(post(http, {"pose": pose_body}).headers["x-request-id"]) == 32
    hostile = http.get("/v1/health/live", headers={"X-Request-Id": 'a" {injected}'})
    assert "injected" not in hostile.headers["x-request-id"]


def test_new_scene_files_appear_without_a_restart(http, service, demo_scene, pose_body):
    path = service.data_folder / "late.ugr"
    assert post(http, {"pose": pose_body}, scene="late").status_code == 404
    demo_scene.save(path)
    try:
        assert post(http, {"pose": pose_body}, scene="late").status_code == 200
    finally:
        path.unlink()


def test_documented_examples_work(http):
    document = http.get("/openapi.json").json()
    operation = document["paths"]["/v1/scenes/{scene}/render"]["post"]
    examples = operation["requestBody"]["content"]["application/json"]["examples"]
    assert len(examples) >= 3
    for example in examples.values():
        body = {"height": 16, "width": 16, **example["value"]}
        assert post(http, body).status_code == 200, example
    assert http.get("/docs").status_code == 200


DICOM = {"Accept": "application/dicom"}


def stored(http, body):
    answer = http.post("/v1/scenes/demo/render", json=body, headers=DICOM)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/dicom"
    return answer, pydicom.dcmread(io.BytesIO(answer.content))


def test_one_frame_holds_the_pixels_and_their_spacing(http, pose_body):
    answer, image = stored(http, {"pose": pose_body, "display": {"gain_db": 6.0}})
    raw = http.post(
        "/v1/scenes/demo/render",
        json={"pose": pose_body, "display": {"gain_db": 6.0}},
        headers={"Accept": "application/octet-stream"},
    )
    assert image.pixel_array.tobytes() == raw.content
    picture = json.loads(answer.headers["x-ultragray-picture"])
    region = image.SequenceOfUltrasoundRegions[0]
    assert (region.PhysicalDeltaX, region.PhysicalDeltaY) == pytest.approx([step / 10 for step in picture["step"]])
    assert (image.SOPClassUID, image.Rows, image.Columns) == (UltrasoundImageStorage, HEIGHT, WIDTH)
    assert "NumberOfFrames" not in image


def test_a_file_holds_the_times_and_the_annotations_of_its_frames(http, pose_body):
    file = io.BytesIO()
    Image.new("LA", (WIDTH, HEIGHT), (255, 255)).save(file, "PNG")
    mark = {"frame": 1, "picture": base64.b64encode(file.getvalue()).decode(), "text": "A  12.3 mm"}
    body = {"poses": [pose_body, pose_body], "frame_times_ms": [5.0, 42.5], "annotations": [mark]}
    _, image = stored(http, body)
    assert [float(way) for way in image.FrameTimeVector] == [0.0, 37.5]
    assert image.ImageComments == "A  12.3 mm"
    assert image.pixel_array[1][: HEIGHT // 2].min() == 255 > image.pixel_array[0].min()
    wrong = [
        ({"frame_times_ms": [5.0]}, "frame_times_ms"),
        ({"frame_times_ms": [5.0, 4.0]}, "frame_times_ms"),
        ({"frame_times_ms": [5.0, 1e9]}, "frame_times_ms"),
        ({"annotations": [{**mark, "frame": 2}]}, "annotations[0].frame"),
        ({"annotations": [{**mark, "picture": "x"}]}, "annotations[0].picture"),
    ]
    for change, field in wrong:
        answer = http.post("/v1/scenes/demo/render", json={**body, **change}, headers=DICOM)
        assert (answer.status_code, answer.json()["field"]) == (422, field)
    for field, value in [("frame_times_ms", [5.0]), ("annotations", [{**mark, "frame": 0}])]:
        answer = http.post(
            "/v1/scenes/demo/render", json={"pose": pose_body, field: value}, headers={"Accept": "image/png"}
        )
        assert (answer.status_code, answer.json()["field"]) == (422, field)


def test_the_annotations_of_a_loop_may_be_larger_than_its_settings(http, pose_body):
    file = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 256, (200, 200, 2), np.uint8)
    Image.fromarray(noise, "LA").save(file, "PNG")
    picture = base64.b64encode(file.getvalue()).decode()
    body = {"poses": [pose_body] * 4, "annotations": [{"frame": frame, "picture": picture} for frame in range(4)]}
    assert len(picture) > 100_000
    assert stored(http, body)[1].NumberOfFrames == 4


def test_other_outputs_and_float_pixels_are_refused(http, pose_body):
    for extra, field in [({"outputs": ["echo"]}, "outputs"), ({"dtype": "float32"}, "dtype")]:
        answer = http.post("/v1/scenes/demo/render", json={"pose": pose_body, **extra}, headers=DICOM)
        assert (answer.status_code, answer.json()["field"]) == (422, field)


LINEAR = {"kind": "linear", "width_mm": 40.0, "near_mm": 5.0, "far_mm": 50.0}


def plane(http, probe):  # [W, 2, 2]: line, end, (x, z)
    answer = http.post("/v1/probes:plane", json=probe)
    assert answer.status_code == 200, answer.text
    document = answer.json()
    return document["face_depth_mm"], np.array(document["lines_mm"]).reshape(-1, 2, 2)


def test_lines_run_from_the_left_edge_of_the_image_to_its_right_one(http):
    face_depth_mm, lines = plane(http, LINEAR)
    assert face_depth_mm == 0.0
    np.testing.assert_allclose(lines[:, :, 0], np.linspace(-20.0, 20.0, len(lines))[:, None] * np.ones(2), atol=1e-6)
    np.testing.assert_allclose(lines[:, :, 1], np.tile([5.0, 50.0], (len(lines), 1)))


def test_each_kind_has_an_example_that_can_be(http):
    schemas = http.get("/openapi.json").json()["components"]["schemas"]
    mapping = schemas["RenderSettings"]["properties"]["probe"]["anyOf"][0]["discriminator"]["mapping"]
    assert {"linear", "convex", "phased"} <= mapping.keys()
    for kind, reference in mapping.items():
        (example,) = schemas[reference.rpartition("/")[2]]["examples"]
        assert example["kind"] == kind
        face_depth_mm, lines = plane(http, example)
        assert math.isfinite(face_depth_mm)
        assert np.isfinite(lines).all()


@pytest.mark.parametrize(
    ("probe", "field"),
    [({**LINEAR, "far_mm": 5.0}, "far_mm"), ({**LINEAR, "width_mm": "wide"}, "width_mm"), ({"kind": "curved"}, "kind")],
)
def test_a_probe_that_cannot_be_is_refused(http, probe, field):
    answer = http.post("/v1/probes:plane", json=probe)
    assert answer.status_code == 422
    assert field in answer.json()["field"] + answer.json()["detail"]


NAMES = ["demo", "empty", "foreign", "probeless", "second", "truncated"]


def test_list_names_every_file_and_what_is_wrong_with_it(http, service):
    page = http.get("/v1/scenes").json()
    assert [entry["name"] for entry in page["scenes"]] == NAMES
    assert page["next_page_token"] == ""
    entries = {entry["name"]: entry for entry in page["scenes"]}
    demo = entries["demo"]
    assert (demo["gaussian_count"], demo["image_height"], demo["image_width"]) == (400, HEIGHT, WIDTH)
    assert (demo["probe_kind"], demo["metrics"]) == ("linear", {"psnr": 20.5})
    changed_s = datetime.fromisoformat(demo["changed_at"]).timestamp()
    assert abs(changed_s - (service.data_folder / "demo.ugr").stat().st_mtime) <= 1
    assert "probe_kind" not in entries["probeless"]
    assert "error" not in demo
    for name in ("empty", "foreign", "truncated"):
        assert entries[name]["error"]["reason"] == "SCENE_FILE_INVALID"
        assert f"{name}.ugr" in entries[name]["error"]["detail"]


@pytest.mark.parametrize("page_size", [1, 4])
def test_pages_join_to_the_whole_list(http, page_size):
    names = []
    token = ""
    while True:
        page = http.get("/v1/scenes", params={"page_size": page_size, "page_token": token}).json()
        assert len(page["scenes"]) <= page_size
        names += [entry["name"] for entry in page["scenes"]]
        token = page["next_page_token"]
        if not token:
            break
    assert names == NAMES


def test_a_scene_says_all_about_itself(http, service):
    scene = http.get("/v1/scenes/demo").json()
    assert scene["probe"] == {"kind": "linear", "width_mm": 40.0, "near_mm": 0.0, "far_mm": 40.0}
    assert scene["centre_mm"] == {"x": 0.0, "y": 0.0, "z": 20.0}
    assert scene["bounds"]["min_mm"]["z"] < 20 < scene["bounds"]["max_mm"]["z"]
    assert (scene["image_height"], scene["image_width"], scene["sh_degree"]) == (HEIGHT, WIDTH, 0)
    assert scene["intensity"] == "released"
    assert scene["metrics"] == {"psnr": 20.5}
    assert scene["dataset_name"] == "synthetic"
    assert scene["file_bytes"] == (service.data_folder / "demo.ugr").stat().st_size
    training = scene["training_poses"]
    assert training["count"] == 5
    assert training["position_max_mm"] == {"x": 0.0, "y": 4.0, "z": 0.0}
    assert training["first"]["quaternion"] == {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
    assert training["middle"]["position_mm"]["y"] == 2.0
    assert training["last"]["matrix"][1] == [0.0, 1.0, 0.0, 4.0]


def test_load_and_unload(http):
    assert http.post("/v1/scenes/second:load").json() == {"scene": "second", "loaded": True, "loaded_processes": 1}
    assert http.get("/v1/scenes/second").json()["loaded"] is True
    assert http.post("/v1/scenes/second:unload").json()["loaded"] is False
    assert http.post("/v1/scenes/second:unload").status_code == 200
    assert http.get("/v1/scenes/second").json()["loaded"] is False
    assert http.post("/v1/scenes/nowhere:unload").json()["reason"] == "SCENE_NOT_FOUND"


def sample(exposition, name):
    """The value of a metric, all its labels together."""
    lines = [line for line in exposition.splitlines() if line.startswith((f"{name} ", f"{name}{{"))]
    assert name in exposition
    return sum(float(line.split()[-1]) for line in lines)


def test_metrics_count_frames_and_keep_the_three_times_apart(http, service):
    service.wait_until_idle()
    identity = {"position_mm": {"x": 0, "y": 0, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}
    before = http.get("/metrics").text
    assert http.post("/v1/scenes/demo/render", json={"poses": [identity] * 3}).status_code == 200
    after = http.get("/metrics").text
    assert sample(after, "ultragray_frames_total") == sample(before, "ultragray_frames_total") + 3
    for stage in ("queue", "render", "encode"):
        name = f"ultragray_{stage}_seconds_count"
        assert sample(after, name) == sample(before, name) + 1
    assert sample(after, "ultragray_processes_alive") == 1
    assert sample(after, "ultragray_process_restarts_total") == 0
    assert sample(after, "ultragray_waiting_frames") == 0
    assert sample(after, "ultragray_loaded_scenes") >= 1
    assert 'ultragray_requests_total{door="http",route="/v1/scenes/{scene}/render",status="200"}' in after


def test_pages_of_allowed_origins_may_call(start_service):
    service = start_service(cors_origins="https://console.example")
    asked = {"Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "content-type"}
    for origin, allowed in (("https://console.example", True), ("https://other.example", False)):
        answer = httpx.options(
            f"{service.http}/v1/scenes/demo/render", headers={"Origin": origin, **asked}, timeout=300
        )
        assert (answer.headers.get("access-control-allow-origin") == origin) is allowed
    answer = httpx.get(f"{service.http}/v1/scenes", headers={"Origin": "https://console.example"}, timeout=300)
    assert "X-Ultragray-Shape" in answer.headers["access-control-expose-headers"]


def test_the_docs_need_nothing_from_outside(http):
    page = http.get("/docs").text
    assets = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert len(assets) >= 3
    for asset in assets:
        assert asset.startswith("/docs/static/")
        assert http.get(asset).status_code == 200


@pytest.mark.parametrize("path", ["/v1/health/live", "/v1/health/ready"])
def test_health_answers_head(http, path):  # what load balancers send
    assert http.head(path).status_code == 200
