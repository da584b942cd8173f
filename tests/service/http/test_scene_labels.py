"""Scenes that are labelled by painted frames and by label maps, through each door."""

import base64
import json

import cv2
import nibabel
import numpy as np
import pytest
from typer.testing import CliRunner

from ultragray import GaussianScene
from ultragray_client import Client, errors
from ultragray_service.cli.app import app

KEY = "0123456789abcdef-labels"
POSE = np.eye(4)
POSE[1, 3] = 1.0
SIDE = 64
NAMES = {"1": "left", "2": "right"}


@pytest.fixture(scope="module")
def service(start_service, artifacts):
    return start_service(artifact_folder=artifacts, api_keys=KEY)


def halves(left=1, right=2):  # a PNG file
    labels = np.full((SIDE, SIDE), left, np.uint8)
    labels[:, SIDE // 2 :] = right
    return cv2.imencode(".png", labels)[1].tobytes()


def text(data):
    return base64.b64encode(data).decode()


def painted(into, png=None, **more):
    frame = {"pose": {"matrix": POSE.tolist()}, "labels": text(halves() if png is None else png)}
    return {"into": into, "frames": [frame], "label_names": NAMES, **more}


def labels_of(http, scene):  # [H, W]
    body = {"pose": {"matrix": POSE.tolist()}, "outputs": ["labels"], "height": SIDE, "width": SIDE}
    answer = http.post(f"/v1/scenes/{scene}/render", json=body, headers={"Accept": "application/octet-stream"})
    assert answer.status_code == 200, answer.text
    return np.frombuffer(answer.content, np.uint8).reshape(SIDE, SIDE)


def refused(answer, reason, field=None):
    assert answer.json()["reason"] == reason, answer.text
    if field is not None:
        assert answer.json()["field"] == field
    return answer.json()["detail"]


def test_painted_frames_make_a_scene_with_labels_and_leave_the_other_as_it_is(http):
    before = http.get("/v1/scenes/demo").json()
    answer = http.post("/v1/scenes/demo:label", json=painted("painted"))
    assert answer.status_code == 201, answer.text
    made = answer.json()
    assert (made["name"], made["label_names"]) == ("painted", NAMES)
    assert "labels" in made["outputs"]
    labels = labels_of(http, "painted")
    seen = labels > 0
    assert seen.mean() > 0.2
    assert (labels[:, :28][seen[:, :28]] == 1).mean() > 0.9
    assert (labels[:, 36:][seen[:, 36:]] == 2).mean() > 0.9
    after = http.get("/v1/scenes/demo").json()
    assert {**after, "loaded": None, "loaded_processes": None} == {**before, "loaded": None, "loaded_processes": None}
    refused(http.post("/v1/scenes/demo:label", json=painted("painted")), "SCENE_EXISTS")


def test_labels_are_replaced_at_once_where_that_is_asked_for(http):
    assert http.post("/v1/scenes/demo:label", json=painted("mine")).status_code == 201
    first = labels_of(http, "mine")
    again = http.post("/v1/scenes/demo:label", json=painted("mine", halves(2, 1), replace=True))
    assert again.status_code == 201, again.text
    second = labels_of(http, "mine")  # of a process that holds the scene
    both = (first > 0) & (second > 0)
    assert (first[both] + second[both] == 3).mean() > 0.98

    detail = refused(http.post("/v1/scenes/demo:label", json=painted("demo", replace=True)), "SCENE_READ_ONLY", "scene")
    assert "data folder" in detail
    np.testing.assert_array_equal(labels_of(http, "mine"), second)


def test_a_scene_with_other_gaussians_is_not_replaced(http, tmp_path, demo_scene):
    splats = {**demo_scene.splats, "sh0": demo_scene.sh0 * 0.5}
    GaussianScene.from_splats(splats, info=demo_scene.info).save(tmp_path / "other.ugr")
    raw = {"Content-Type": "application/octet-stream"}
    assert http.put("/v1/scenes/other", content=(tmp_path / "other.ugr").read_bytes(), headers=raw).status_code == 201
    answer = http.post("/v1/scenes/demo:label", json=painted("other", replace=True))
    refused(answer, "SCENE_EXISTS", "into")
    assert http.get("/v1/scenes/other").json()["label_names"] == {}


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"frames": []}, "frames"),
        ({"label_names": {"1": "left"}}, "label_names"),
        ({"frames": [{"pose": {"matrix": POSE.tolist()}, "labels": "no base64"}]}, "frames[0].labels"),
        ({"frames": [{"pose": {"matrix": POSE.tolist()}, "labels": text(b"no PNG")}]}, "frames[0].labels"),
        ({"frames": [{"pose": {"matrix": [[0.0] * 4] * 4}, "labels": text(b"")}]}, "frames[0].pose.matrix"),
        ({"within_mm": -1}, "within_mm"),
        ({"into": "../up"}, "scene"),
        ({"registration": "nobody's"}, "registration"),
    ],
)
def test_what_cannot_be_labelled_is_refused_and_leaves_nothing(http, change, field):
    answer = http.post("/v1/scenes/demo:label", json=painted("none") | change)
    assert answer.status_code in (404, 422), answer.text
    assert answer.json()["field"] == field
    refused(http.get("/v1/scenes/none"), "SCENE_NOT_FOUND")


@pytest.fixture
def label_map(tmp_path):
    """Left and right of the scene's middle, in the frame of a scanner 30 mm beside."""
    volume = np.ones((80, 60, 80), np.uint8)
    volume[40:] = 2
    affine = np.eye(4)
    affine[:3, 3] = [-10.0, -30.0, -20.0]
    nibabel.save(nibabel.Nifti1Image(volume, affine), tmp_path / "map.nii.gz")
    shifted = np.eye(4)
    shifted[0, 3] = -30.0
    (tmp_path / "scanner.json").write_text(json.dumps({"format_version": 1, "base_to_scene": shifted.tolist()}))
    return tmp_path / "map.nii.gz"


def is_left_and_right(labels):
    seen = labels > 0
    return (labels[:, :28][seen[:, :28]] == 1).all() and (labels[:, 36:][seen[:, 36:]] == 2).all() and seen.any()


@pytest.mark.parametrize("data", [b"", b"no map", b"\x1f\x8b cut", bytes(348)])
def test_what_is_no_label_map_is_refused_without_saying_where_it_was_kept(http, data):
    body = {"into": "none", "label_map": text(data)}
    detail = refused(http.post("/v1/scenes/demo:label-by-map", json=body), "INVALID_ARGUMENT", "label_map")
    assert "/" not in detail


def test_a_registered_label_map_does_the_same_by_every_door(service, http, label_map, tmp_path):
    shifted = json.loads((tmp_path / "scanner.json").read_text())["base_to_scene"]
    assert http.put("/v1/registrations/scanner", json={"scene": "demo", "base_to_scene": shifted}).is_success
    map_text = text(label_map.read_bytes())
    body = {"into": "by-http", "label_map": map_text, "label_names": NAMES, "registration": "scanner", "within_mm": 0}
    answer = http.post("/v1/scenes/demo:label-by-map", json=body)
    assert answer.status_code == 201, answer.text
    by_http = labels_of(http, "by-http")
    assert is_left_and_right(by_http)

    with Client(service.grpc, api_key=KEY) as client:
        made = client.scenes.label(
            "demo",
            into="by-grpc",
            label_map=label_map.read_bytes(),
            label_names={1: "left", 2: "right"},
            registration="scanner",
            within_mm=0.0,
        )
        assert made.label_names == {1: "left", 2: "right"}
        again = client.scenes.label(
            "demo", into="by-grpc", frames=[(POSE, halves())], label_names={1: "left", 2: "right"}, replace=True
        )
        assert again.name == "by-grpc"
        with pytest.raises(errors.SceneExists):
            client.scenes.label("demo", into="by-grpc", frames=[(POSE, halves())], label_names={1: "left", 2: "r"})

    environment = {"ULTRAGRAY_ADDRESS": service.http, "ULTRAGRAY_API_KEY": KEY}
    names = ["--names", "1=left,2=right", "--within-mm", "0"]

    def run(*arguments):
        result = CliRunner().invoke(app, list(map(str, arguments)), env=environment)
        assert result.exit_code == 0, result.output

    run("scenes", "label", "demo", "--into", "by-cli", "--map", label_map, *names, "--registration", "scanner")
    np.testing.assert_array_equal(labels_of(http, "by-cli"), by_http)
    run("scenes", "download", "demo", "-o", tmp_path / "demo.ugr")
    labelled = tmp_path / "labelled.ugr"
    by_map = ["--map", label_map, *names, "--registration", tmp_path / "scanner.json"]
    run("label", tmp_path / "demo.ugr", "-o", labelled, *by_map)
    run("scenes", "upload", labelled, "--name", "by-file")
    np.testing.assert_array_equal(labels_of(http, "by-file"), by_http)

    rendered = tmp_path / "painted.npz"  # what one scene shows, painted on the other
    run("render", labelled, "-o", rendered, "--height", SIDE, "--width", SIDE, "--outputs", "labels")
    run("scenes", "label", "demo", "--into", "by-frames", "--frames", rendered, *names)
    assert is_left_and_right(labels_of(http, "by-frames"))
