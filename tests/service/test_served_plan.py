"""Where to look next through HTTP, gRPC and the client: one plan at every door, and what is wrong is told."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

import ultragray
from ultragray import plan_views
from ultragray.phantom.demo import DEMO_FILE, demo_poses, load_demo_scene
from ultragray_client import PlanSettings
from ultragray_client.errors import InvalidArgument, InvalidPose, SceneNotFound, TooManyPoses

PATH = "/v1/scenes/spine:plan"
ASKED = {"views": 4, "within_mm": 0.5, "tilt_deg": 20.0}


@pytest.fixture(scope="module")
def service(start_service, tmp_path_factory, artifacts):
    folder = tmp_path_factory.mktemp("planned")
    shutil.copy(DEMO_FILE, folder / "spine.ugr")
    return start_service(data_folder=folder, artifact_folder=artifacts)


def test_every_door_has_the_plan_of_the_library(http, client):
    wanted = plan_views(load_demo_scene(), ultragray.PlanSettings(**ASKED))
    answer = http.post(PATH, json=ASKED)
    assert answer.status_code == 200, answer.text
    told = answer.json()
    planned = client.plan_views("spine", PlanSettings(**ASKED))
    for poses, gains in (
        ([one["pose"] for one in told["views"]], [one["gain"] for one in told["views"]]),
        ([one.pose for one in planned.views], [one.gain for one in planned.views]),
    ):
        np.testing.assert_allclose(np.array(poses), wanted.poses, atol=1e-6)
        np.testing.assert_allclose(gains, wanted.gains, atol=1e-6)
    assert [one.rank for one in planned.views] == wanted.ranks.tolist()
    assert planned.path_mm == pytest.approx(told["path_mm"]) == pytest.approx(wanted.path_mm)
    assert (planned.before, planned.after) == pytest.approx((wanted.before, wanted.after))


def test_a_list_of_poses_a_standard_plane_and_a_start_are_taken(http, client):
    listed = demo_poses(40) @ shifted(3.0)
    view, start = listed[12], listed[0]
    planned = client.plan_views("spine", PlanSettings(views=3, within_mm=0.3), poses=listed, view=view, start=start)
    document = {"poses": [{"matrix": one.tolist()} for one in listed], "views": 3, "within_mm": 0.3}
    told = http.post(
        PATH, json={**document, "view": {"matrix": view.tolist()}, "start": {"matrix": start.tolist()}}
    ).json()
    assert told["views"][0]["pose"] == pytest.approx(planned.views[0].pose)
    chosen = next(one for one in planned.views if one.rank == 0)
    assert min(np.abs(listed - chosen.pose).max(axis=(1, 2))) < 1e-6


def test_a_registration_leads_poses_in_and_out(client):
    base_to_scene = shifted(10.0)
    client.registrations.put("robot", "spine", base_to_scene)
    listed = demo_poses(10) @ shifted(2.0)
    in_base = np.linalg.inv(base_to_scene) @ listed
    asked = PlanSettings(views=2, within_mm=0.3)
    planned = client.plan_views("spine", asked, poses=in_base, registration="robot")
    for one, plain in zip(planned.views, client.plan_views("spine", asked, poses=listed).views, strict=True):
        np.testing.assert_allclose(one.pose, plain.pose, atol=1e-6)
        np.testing.assert_allclose(base_to_scene @ one.flange_to_base, one.pose, atol=1e-6)


def shifted(y_mm: float) -> np.ndarray:  # [4, 4]
    motion = np.eye(4)
    motion[1, 3] = y_mm
    return motion


@pytest.mark.parametrize(
    ("document", "reason", "field"),
    [
        ({"want": "fame"}, "INVALID_ARGUMENT", "want"),
        ({"views": 0}, "INVALID_ARGUMENT", "views"),
        ({"region_mm": "1:2"}, "INVALID_ARGUMENT", "region_mm"),
        ({"plane": [0, 0, 0, 1]}, "INVALID_ARGUMENT", "plane"),
        ({"label": 77}, "INVALID_ARGUMENT", "label"),
        ({"box_mm": "900:910,0:1,0:1"}, "INVALID_ARGUMENT", "box_mm"),
        ({"start": {"matrix": np.zeros((4, 4)).tolist()}}, "INVALID_POSE", "start.matrix"),
        ({"poses": []}, "INVALID_ARGUMENT", "poses"),
    ],
)
def test_what_is_wrong_is_told_by_its_field(http, document, reason, field):
    problem = http.post(PATH, json=document)
    assert (problem.status_code, problem.json()["reason"], problem.json()["field"]) == (422, reason, field)


def test_the_client_raises_what_is_wrong(client):
    with pytest.raises(InvalidArgument, match="views"):
        client.plan_views("spine", PlanSettings(views=1000))
    with pytest.raises(SceneNotFound):
        client.plan_views("nowhere")
    with pytest.raises(InvalidPose):
        client.plan_views("spine", start=np.zeros((4, 4)))
    with pytest.raises(TooManyPoses):
        client.plan_views("spine", poses=demo_poses(5000))


def test_a_plan_that_takes_too_long_is_given_up(http):
    answer = http.post(PATH, json={**ASKED, "timeout_ms": 1.0})
    assert (answer.status_code, answer.json()["reason"]) == (504, "DEADLINE_EXCEEDED")
