"""Registrations are service by name, and clients send poses in their own frame."""

from json import dumps, loads

import numpy as np
import pytest
from websockets.sync.client import connect

from ultragray_client import AroundSampler, Client, JobState, RenderJob, RenderSettings, errors
from ultragray_service.access.keys import KeyStore
from ultragray_service.access.principals import Role
from ultragray_workers.jobs.database import JobDatabase

from ..model.test_registration import motion
from .conftest import split

SIZE = {"height": 16, "width": 12}
ROLES = {"alice": Role.OPERATOR, "bob": Role.OPERATOR, "reader": Role.READER}


BASE_TO_SCENE, MOUNTING = (motion(np.random.default_rng(seed)) for seed in range(2))
POSE = np.eye(4)
POSE[1, 3] = 2.0
FLANGE = np.linalg.inv(BASE_TO_SCENE) @ POSE @ np.linalg.inv(MOUNTING)


@pytest.fixture(scope="module")
def service(start_service, artifacts):
    return start_service(artifact_folder=artifacts)


@pytest.fixture(scope="module", autouse=True)
def robot(client):
    client.registrations.put("robot", "demo", BASE_TO_SCENE, MOUNTING, quality={"residual_mm": 0.4})


def test_a_registration_comes_back_as_it_was_put(client, http):
    found = client.registrations.get("robot")
    np.testing.assert_allclose(found.base_to_scene, BASE_TO_SCENE, atol=1e-12)
    np.testing.assert_allclose(found.probe_to_flange, MOUNTING, atol=1e-12)
    assert (found.scene, found.residual_mm, found.position_std_mm) == ("demo", 0.4, None)
    told = http.get("/v1/registrations/robot").json()
    np.testing.assert_allclose(told["base_to_scene"], BASE_TO_SCENE, atol=1e-12)
    assert told["owner"] == "local:"


def test_a_frame_of_a_flange_pose_is_that_of_the_probe_pose(client):
    plain = client.render("demo", POSE, RenderSettings(**SIZE))
    led = client.render("demo", FLANGE, RenderSettings(**SIZE, registration="robot"))
    np.testing.assert_allclose(led.pose, POSE, atol=1e-9)
    np.testing.assert_allclose(led["bmode"].astype(int), plain["bmode"], atol=1)
    assert (led.registration, plain.registration) == ("robot", None)
    again = client.render("demo", led.pose, RenderSettings(**SIZE))
    np.testing.assert_array_equal(again["bmode"], led["bmode"])


def test_batches_streams_and_assessments_are_led_as_well(client):
    settings = RenderSettings(**SIZE, registration="robot")
    batch = list(client.render_batch("demo", [FLANGE, FLANGE], settings))
    with client.stream("demo", settings) as stream:
        stream.send(FLANGE)
        streamed = stream.receive()
    for frame in (*batch, streamed):
        np.testing.assert_allclose(frame.pose, POSE, atol=1e-9)
        assert frame.registration == "robot"
    (led,) = client.assess_poses("demo", [FLANGE], registration="robot")
    (plain,) = client.assess_poses("demo", [POSE])
    assert led.distance_mm == pytest.approx(plain.distance_mm)


def test_http_and_websocket_take_it_too(service, http):
    asked = {"pose": {"matrix": FLANGE.tolist()}, "registration": "robot", **SIZE}
    answer = http.post("/v1/scenes/demo/render", json=asked)
    assert answer.status_code == 200, answer.text
    assert answer.headers["X-Ultragray-Registration"] == "robot"
    np.testing.assert_allclose(loads(answer.headers["X-Ultragray-Pose"]), POSE, atol=1e-9)
    poses = {"poses": [{"matrix": FLANGE.tolist()}], "registration": "robot"}
    assert http.post("/v1/scenes/demo:assess", json=poses).status_code == 200
    message = {"settings": {**SIZE, "registration": "robot"}, "pose": {"matrix": FLANGE.tolist()}}
    with connect(service.stream_url()) as socket:
        socket.send(dumps(message))
        answered = socket.recv(timeout=300)
    np.testing.assert_allclose(split(answered)[0]["pose"], POSE, atol=1e-9)


def test_an_unknown_one_and_one_of_another_scene_are_told(client, http):
    with pytest.raises(errors.RegistrationNotFound) as unknown:
        client.render("demo", FLANGE, RenderSettings(registration="nobody"))
    assert unknown.value.field == "settings.registration"
    with pytest.raises(errors.InvalidArgument, match="'robot' is of 'demo'"):
        client.render("second", FLANGE, RenderSettings(registration="robot"))
    assert http.get("/v1/registrations/nobody").status_code == 404
    assert http.delete("/v1/registrations/nobody").status_code == 404


@pytest.mark.parametrize(
    ("change", "status", "field"),
    [
        ({"base_to_scene": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()}, 422, "base_to_scene"),
        ({"scene": "nowhere"}, 404, "scene"),
        ({"residual_mm": -1.0}, 422, "residual_mm"),
        ({"colour": "red"}, 422, "colour"),
    ],
)
def test_what_is_no_registration_is_refused(http, change, status, field):
    body = {"scene": "demo", "base_to_scene": np.eye(4).tolist()} | change
    answer = http.put("/v1/registrations/wrong", json=body)
    assert (answer.status_code, answer.json()["field"]) == (status, field), answer.text
    assert http.get("/v1/registrations/wrong").status_code == 404


def test_owners_alone_replace_and_delete_and_readers_use(start_service, tmp_path):
    database = JobDatabase(tmp_path, None)
    keys = {name: KeyStore(database.engine).create(name, role, 1.0)[1] for name, role in ROLES.items()}
    database.close()
    service = start_service(artifact_folder=tmp_path)
    clients = {name: Client(service.grpc, api_key=key, timeout_s=300.0) for name, key in keys.items()}
    clients["alice"].registrations.put("arm", "demo", BASE_TO_SCENE, MOUNTING)
    with pytest.raises(errors.PermissionDenied, match="somebody else's"):
        clients["bob"].registrations.put("arm", "demo", np.eye(4))
    with pytest.raises(errors.PermissionDenied, match="to be the owner's: the registration 'arm' is alice's"):
        clients["bob"].registrations.delete("arm")
    with pytest.raises(errors.PermissionDenied, match="needs the role operator"):
        clients["reader"].registrations.put("other", "demo", np.eye(4))
    settings = RenderSettings(**SIZE, registration="arm")
    np.testing.assert_allclose(clients["reader"].render("demo", FLANGE, settings).pose, POSE, atol=1e-9)
    clients["alice"].registrations.delete("arm")
    for client in clients.values():
        client.close()


def flange_job(**changes):
    asked = {**SIZE, "poses": [FLANGE], "registration": "robot", "dtype": "uint8", **changes}
    return RenderJob(scene="demo", **asked)


def test_a_job_keeps_the_registration_that_it_was_accepted_with(start_service, tmp_path):
    first = start_service(artifact_folder=tmp_path)
    with Client(first.grpc, timeout_s=300.0) as client:
        client.registrations.put("robot", "demo", BASE_TO_SCENE, MOUNTING)
        plain = client.render("demo", POSE, RenderSettings(**SIZE))
        job = client.jobs.submit(flange_job(), request_id="mine")
        assert (job.specification.registration, job.pose_count) == ("robot", 1)
        client.registrations.put("robot", "demo", np.eye(4))
        assert client.jobs.submit(flange_job(), request_id="mine").id == job.id
        with pytest.raises(errors.RequestIdConflict):
            client.jobs.submit(flange_job(poses=[POSE]), request_id="mine")
        client.registrations.delete("robot")
        client.jobs.cancel(job.id)
        retried = client.jobs.retry(job.id)
        assert (retried.specification.registration, retried.pose_count) == ("robot", 1)
    first.terminate()
    with Client(start_service(artifact_folder=tmp_path, embedded_worker=True).grpc, timeout_s=300.0) as client:
        assert client.jobs.wait(retried.id).state is JobState.SUCCEEDED
        client.jobs.download(retried.id, "frames.npz", tmp_path / "frames.npz")
    with np.load(tmp_path / "frames.npz") as archive:
        np.testing.assert_allclose(archive["poses"], [POSE], atol=1e-9)
        np.testing.assert_allclose(archive["bmode"][0].astype(int), plain["bmode"], atol=1)


def test_estimates_and_samplers_are_led_as_well(http):
    sampler = {"kind": "around", "count": 3, "seed": 1}
    specification = {"scene": "demo", **SIZE, "poses": [FLANGE.tolist()], "registration": "robot", "sampler": sampler}
    led = http.post("/v1/jobs:estimate", json={"kind": "render", "specification": specification}).json()
    specification |= {"poses": [POSE.tolist()], "registration": None}
    plain = http.post("/v1/jobs:estimate", json={"kind": "render", "specification": specification}).json()
    np.testing.assert_allclose(led["poses"], plain["poses"], atol=1e-9)


def test_what_a_registration_cannot_lead_is_refused_at_the_submission(client):
    with pytest.raises(errors.RegistrationNotFound) as unknown:
        client.jobs.submit(flange_job(registration="nobody"))
    assert unknown.value.field == "render.registration"
    with pytest.raises(errors.InvalidArgument, match="'robot' is of 'demo'"):
        client.jobs.submit(RenderJob(scene="second", poses=[FLANGE], registration="robot"))
    with pytest.raises(errors.InvalidArgument, match="poses must be given where a registration leads them"):
        client.jobs.submit(flange_job(poses=None, sampler=AroundSampler(count=2)))
