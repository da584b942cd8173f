import asyncio
import copy
import json
import socket

import numpy as np
import pytest

from ultragray.errors import InvalidArgument
from ultragray_service.http import bodies

ROTATED = np.eye(4)
GOOD_POSE = {"matrix": ROTATED.tolist()}
PLACED = {"position_mm": {"x": 0.0, "y": 0.0, "z": 0.0}, "quaternion": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}}
LINEAR = {"kind": "linear", "width_mm": 40.0, "near_mm": 0.0, "far_mm": 40.0}


@pytest.fixture(autouse=True)
def _renders_afterwards(http):
    """Whatever was sent, the service answers the next good request."""
    yield
    answer = http.post("/v1/scenes/demo/render", json={"pose": GOOD_POSE}, headers={"Accept": "image/png"})
    assert answer.status_code == 200


def matrix(place, value):
    values = np.eye(4)
    values[place] = value
    return {"matrix": values.tolist()}


def placed(part, **changes):
    pose = copy.deepcopy(PLACED)
    pose[part].update(changes)
    return pose


def assert_problem(answer, status, reason, field):
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    problem = answer.json()
    assert (answer.status_code, problem["reason"], problem["field"]) == (status, reason, field), problem
    assert set(problem) == {"type", "title", "status", "detail", "reason", "field", "request_id"}
    assert problem["status"] == status
    assert problem["request_id"] == answer.headers["x-request-id"]
    assert problem["title"]
    assert problem["detail"]
    return problem


BAD_BODIES = {
    "second of two": ({"poses": [GOOD_POSE, matrix((0, 0), -1)]}, "INVALID_POSE", "poses[1].matrix"),
    "text in matrix": ({"pose": {"matrix": [["1", 0, 0, 0]] * 4}}, "INVALID_POSE", "pose.matrix[0][0]"),
    "no w": ({"poses": [GOOD_POSE, {**PLACED, "quaternion": {}}]}, "INVALID_POSE", "poses[1].quaternion.w"),
    "far away": ({"pose": placed("position_mm", x=1e7)}, "INVALID_POSE", "pose"),
    "no pose": ({}, "INVALID_ARGUMENT", "pose"),
    "too many poses": ({"poses": [GOOD_POSE] * 41}, "TOO_MANY_POSES", "poses"),
    "unknown key": ({"pose": GOOD_POSE, "hieght": 5}, "INVALID_ARGUMENT", "hieght"),
    "width beyond the limit": ({"pose": GOOD_POSE, "width": 601}, "INVALID_IMAGE_SIZE", "width"),
    "unknown output": ({"pose": GOOD_POSE, "outputs": ["bmode", "doppler"]}, "UNKNOWN_OUTPUT", "outputs"),
    "probe without kind": ({"pose": GOOD_POSE, "probe": {}}, "INVALID_PROBE", "probe.kind"),
}


@pytest.mark.parametrize("case", BAD_BODIES)
def test_bad_body(http, case):
    body, reason, field = BAD_BODIES[case]
    problem = assert_problem(http.post("/v1/scenes/demo/render", json=body), 422, reason, field)
    assert field is None or field in problem["detail"]


@pytest.mark.parametrize("literal", ["NaN", "1e999"])
def test_numbers_that_are_not_finite(http, literal):
    body = json.dumps({"poses": [GOOD_POSE, PLACED]}).replace('{"x": 0.0', f'{{"x": {literal}', 1)
    answer = http.post("/v1/scenes/demo/render", content=body, headers={"Content-Type": "application/json"})
    assert_problem(answer, 422, "INVALID_POSE", "poses[1].position_mm.x")


@pytest.mark.parametrize("body", [b"", b"[]", b'{"pose": ', b"\xff\xfe", b"[" * 100_000])
def test_bodies_that_are_no_object(http, body):
    answer = http.post("/v1/scenes/demo/render", content=body, headers={"Content-Type": "application/json"})
    assert_problem(answer, 422, "INVALID_ARGUMENT", None)


@pytest.mark.parametrize(
    ("scene", "status", "reason"),
    [
        ("nowhere", 404, "SCENE_NOT_FOUND"),
        ("..", 404, "SCENE_NOT_FOUND"),
        ("%2e%2e", 404, "SCENE_NOT_FOUND"),
        ("truncated", 422, "SCENE_FILE_INVALID"),
        ("foreign", 422, "SCENE_FILE_INVALID"),
        ("empty", 422, "SCENE_FILE_INVALID"),
    ],
)
def test_scenes_that_cannot_be_rendered(http, scene, status, reason):
    if scene == "..":
        scene = "..%20"
    for suffix in ("/render", ":load"):
        answer = http.post(f"/v1/scenes/{scene}{suffix}", json={"pose": GOOD_POSE})
        assert_problem(answer, status, reason, "scene")
    assert_problem(http.get(f"/v1/scenes/{scene}"), status, reason, "scene")


def test_a_scene_without_a_probe_needs_one(http):
    answer = http.post("/v1/scenes/probeless/render", json={"pose": GOOD_POSE})
    assert_problem(answer, 422, "INVALID_PROBE", "probe")


@pytest.mark.parametrize("accept", ["image/png", "image/jpeg;q=0.5, image/*", "text/html"])
def test_accept_that_cannot_hold_the_request(http, accept):
    body = {"poses": [GOOD_POSE, GOOD_POSE]}
    answer = http.post("/v1/scenes/demo/render", json=body, headers={"Accept": accept})
    problem = assert_problem(answer, 406, "NOT_ACCEPTABLE", "Accept")
    assert "application/x-npz" in problem["detail"]


@pytest.mark.parametrize(("name", "value"), [("Content-Type", "text/plain"), ("Content-Encoding", "gzip")])
def test_bodies_that_are_not_json(http, name, value):
    headers = {"Content-Type": "application/json", name: value}
    answer = http.post("/v1/scenes/demo/render", content=b"{}", headers=headers)
    assert_problem(answer, 415, "UNSUPPORTED_MEDIA_TYPE", name)


def test_unknown_route_and_method(http):
    assert_problem(http.get("/v1/nothing"), 404, "ROUTE_NOT_FOUND", None)
    answer = http.patch("/v1/scenes/demo")
    assert_problem(answer, 405, "METHOD_NOT_ALLOWED", None)
    assert answer.headers["allow"] == "DELETE, GET, PUT"
    assert_problem(http.get("/v1/scenes/demo/render"), 405, "METHOD_NOT_ALLOWED", None)


@pytest.mark.parametrize(
    ("name", "value"), [("page_size", "0"), ("page_size", "1001"), ("page_size", "many"), ("page_token", "*")]
)
def test_pages_that_there_are_none_of(http, name, value):
    assert_problem(http.get("/v1/scenes", params={name: value}), 422, "INVALID_ARGUMENT", name)


def test_an_answer_of_too_many_pixels(http):
    body = {"poses": [GOOD_POSE] * 12, "height": 600, "width": 600}
    assert_problem(http.post("/v1/scenes/demo/render", json=body), 422, "TOO_MANY_POSES", "poses")


def test_deadline(http):
    body = {"poses": [GOOD_POSE] * 8, "height": 600, "width": 600, "timeout_ms": 0.01}
    assert_problem(http.post("/v1/scenes/demo/render", json=body), 504, "DEADLINE_EXCEEDED", None)


def test_a_body_that_its_route_does_not_take_is_refused_before_it_comes(http):
    """Large bodies of one client are not read while frames of others wait."""
    with socket.create_connection((http.base_url.host, http.base_url.port), timeout=60.0) as opened:
        head = b"POST /v1/scenes/demo:assess HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        opened.sendall(head + b"Content-Length: 2000000\r\n\r\n")
        assert opened.recv(65536).startswith(b"HTTP/1.1 413 ")


def test_more_values_than_poses_could_have_are_refused_before_they_are_decoded(monkeypatch):
    """A megabyte of numbers holds the interpreter, and with it every other client, for 60 ms."""
    monkeypatch.setattr(bodies.json, "loads", lambda text: pytest.fail("it was decoded"))
    body = json.dumps({"poses": [np.eye(4).tolist()] * 10_000}).encode()
    with pytest.raises(InvalidArgument, match="must hold at most 40960 values"):
        asyncio.run(bodies.read_large(body, bodies.AssessBody, bodies.AssessBody.many_poses(1024)))
