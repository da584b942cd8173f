"""A real frame is found in a scene through HTTP, gRPC and the client, and what is wrong with it is told."""

import base64
import shutil

import httpx
import numpy as np
import pytest

from ultragray import render
from ultragray.phantom.demo import DEMO_FILE, demo_poses, load_demo_scene
from ultragray.rendering.pixels import png_file, to_uint8
from ultragray_client import Client
from ultragray_client.errors import InvalidArgument

from ..waiting import Deadline

SIDE = 128
POSE = demo_poses(3)[1]  # [4, 4] mm
KEY = "0123456789abcdef-limited"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("phantom")
    shutil.copy(DEMO_FILE, made / "spine.ugr")
    return made


@pytest.fixture(scope="module")
def service(start_service, folder, artifacts):
    return start_service(data_folder=folder, artifact_folder=artifacts)


@pytest.fixture(scope="module")
def pixels():  # [SIDE, SIDE] uint8
    frame = render(load_demo_scene(), None, POSE, height=SIDE, width=SIDE, outputs=("bmode",))["bmode"][0]
    return to_uint8(frame.detach().numpy())


@pytest.fixture(scope="module")
def png(pixels):
    return png_file(pixels)


def start():
    pose = POSE.copy()
    pose[:3, 3] += (1.5, -1.0, 1.0)
    return pose


def body(image, **fields):
    return {"image": base64.b64encode(image).decode(), "start": {"matrix": start().tolist()}, **fields}


def test_a_png_file_is_found_over_http(http, png):
    answer = http.post("/v1/scenes/spine:localize", json=body(png))
    assert answer.status_code == 200, answer.text
    found = answer.json()
    assert found["is_found"]
    assert found["similarity"] > 0.9
    np.testing.assert_allclose(found["pose"], POSE, atol=0.2)
    assert all(0.0 < one < 0.5 for one in found["position_std_mm"])
    assert found["shift_mm"] == pytest.approx(np.linalg.norm((1.5, -1.0, 1.0)), abs=0.3)
    assert found["scene"] == "spine"
    assert found["search_ms"] > 0.0


def test_arrays_and_files_are_found_by_the_client(service, pixels, png):
    with Client(service.grpc, timeout_s=300.0) as client:
        of_array = client.localize("spine", pixels / np.float32(255.0), start())
        of_file = client.localize("spine", png, start())
    assert of_array.is_found
    np.testing.assert_allclose(of_array.pose, POSE, atol=0.2)
    np.testing.assert_array_equal(of_array.pose, of_file.pose)
    assert len(of_array.position_std_mm) == 3


def test_start_and_answer_are_in_the_frame_of_a_registration(service, http, pixels, png):
    base_to_scene, mounting = np.eye(4), np.eye(4)
    base_to_scene[:3] = ((0, -1, 0, 400), (1, 0, 0, -30), (0, 0, 1, 5))
    mounting[:3, 3] = (0, 0, 142)

    def in_base(pose):
        return np.linalg.inv(base_to_scene) @ pose @ np.linalg.inv(mounting)

    with Client(service.grpc, timeout_s=300.0) as client:
        client.registrations.put("robot", "spine", base_to_scene, mounting)
        found = client.localize("spine", pixels, in_base(start()), registration="robot")
        plain = client.localize("spine", pixels, start())
    assert (found.is_found, found.registration) == (True, "robot")
    np.testing.assert_allclose(found.pose, POSE, atol=0.2)
    np.testing.assert_allclose(found.flange_to_base, in_base(found.pose), atol=1e-9)
    assert (plain.registration, plain.flange_to_base) == (None, None)
    asked = body(png, start={"matrix": in_base(start()).tolist()}, registration="robot")
    told = http.post("/v1/scenes/spine:localize", json=asked).json()
    np.testing.assert_allclose(told["flange_to_base"], found.flange_to_base, atol=1e-9)
    refused = http.post("/v1/scenes/spine:localize", json=body(png, registration="nobody"))
    assert (refused.status_code, refused.json()["field"]) == (404, "registration")


def test_a_frame_is_tracked_and_found_from_nowhere_at_both_doors(service, http, pixels, png):
    tracked = http.post("/v1/scenes/spine:localize", json=body(png, search="track")).json()
    np.testing.assert_allclose(tracked["pose"], POSE, atol=0.2)
    asked = {key: value for key, value in body(png, search="anywhere").items() if key != "start"}
    told = http.post("/v1/scenes/spine:localize", json=asked).json()
    np.testing.assert_allclose(told["pose"], POSE, atol=0.2)
    with Client(service.grpc, timeout_s=300.0) as client:
        found = client.localize("spine", pixels, search="anywhere")
        on = client.localize("spine", pixels, start(), search="track")
        with pytest.raises(InvalidArgument, match="start is required, unless search is anywhere"):
            client.localize("spine", pixels)
    np.testing.assert_array_equal(found.pose, told["pose"])
    np.testing.assert_array_equal(on.pose, tracked["pose"])
    del asked["search"]
    refused = http.post("/v1/scenes/spine:localize", json=asked)
    assert (refused.status_code, refused.json()["field"]) == (422, "start")


def test_a_frame_of_something_else_is_told_as_not_found(http):
    noise = np.random.default_rng(0).integers(0, 256, (SIDE, SIDE), dtype=np.uint8)
    asked = body(noise.tobytes(), image_height=SIDE, image_width=SIDE)
    assert not http.post("/v1/scenes/spine:localize", json=asked).json()["is_found"]
    text = http.get("/metrics").text
    assert 'ultragray_searches_total{found="false",scene="spine"} 1.0' in text


@pytest.mark.parametrize(
    ("change", "field", "told"),
    [
        ({"image": "no base64!"}, "image", "image must be base64"),
        ({"image_height": 64, "image_width": 64}, "image", "must hold image_height x image_width = 4096 bytes"),
        ({"within_mm": 21}, "within_mm", "above 0 and at most 20"),
    ],
)
def test_each_mistake_gets_one_error(http, png, change, field, told):
    answer = http.post("/v1/scenes/spine:localize", json=body(png) | change)
    assert answer.status_code == 422, answer.text
    problem = answer.json()
    assert problem["field"] == field
    assert told in problem["detail"]


def test_a_search_ends_at_its_deadline_and_with_its_caller(http, png):
    late = http.post("/v1/scenes/spine:localize", json=body(png, timeout_ms=1))
    assert late.status_code == 504
    asked = body(png, within_mm=20, within_deg=30)
    with pytest.raises(httpx.ReadTimeout):
        http.post("/v1/scenes/spine:localize", json=asked, timeout=httpx.Timeout(60.0, read=0.05))
    end = Deadline(60.0)
    while http.get("/v1/statistics").json()["busy_processes"]:
        assert not end.passed


def test_a_search_counts_as_many_frames_of_the_key(start_service, folder, png, tmp_path):
    service = start_service(data_folder=folder, artifact_folder=tmp_path, api_keys=KEY, key_frames_per_s=20)
    headers = {"X-API-Key": KEY}
    with httpx.Client(base_url=service.http, timeout=300.0, headers=headers) as client:
        answer = client.post("/v1/scenes/spine:localize", json=body(png, timeout_ms=3000))
        assert answer.status_code == 422, answer.text
        assert "frames_per_s" in answer.json()["detail"]
        assert httpx.post(f"{service.http}/v1/scenes/spine:localize", json=body(png), timeout=300).status_code == 401
