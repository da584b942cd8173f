"""What is private is not there for others, at any door; what is not can be read by all, and changed by its owner."""

import base64
import json
import re
import time

import cv2
import grpc
import numpy as np
import pytest
import sqlalchemy as sa
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from ultragray_proto.v1 import geometry_pb2, rendering_pb2, scenes_pb2
from ultragray_service.access.rules import GRPC_OPERATIONS, WEBSOCKET, HttpRules
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.owners import Kind
from ultragray_workers.jobs.tables import WORKERS

from ...waiting import wait_until
from .conftest import MATRIX, POSE
from .test_audit import entries
from .test_matrix import call

FIRST = "a-hidden-one"  # a private scene that stands first where messages name those that there are


@pytest.fixture(scope="module")
def private(keyed, scene_bytes, dataset_bytes):
    """The id of a private job of alice's; her scene and dataset are called secret, another scene FIRST."""
    for name in ("secret", FIRST):
        answer = keyed.http("alice", "PUT", f"/v1/scenes/{name}?private=true", content=scene_bytes)
        assert (answer.status_code, answer.json()["owner"], answer.json()["private"]) == (201, "alice", True)
    answer = keyed.http("alice", "PUT", "/v1/datasets/secret?private=true", content=dataset_bytes)
    assert (answer.status_code, answer.json()["owner"], answer.json()["private"]) == (201, "alice", True)
    registration = {"scene": "secret", "base_to_scene": MATRIX}
    assert keyed.http("alice", "PUT", "/v1/registrations/secret", json=registration).status_code == 200
    answer = keyed.submit("alice", private=True, scene="secret")
    assert (answer.status_code, answer.json()["owner"], answer.json()["private"]) == (201, "alice", True)
    return str(answer.json()["id"])


def names(keyed, who, what):
    found = keyed.http(who, "GET", f"/v1/{what}").json()[what]
    return {one.get("name", one.get("id")) for one in found}


def test_lists_leave_out_what_others_keep_to_themselves(keyed, private):
    for what in ("scenes", "datasets", "registrations", "jobs"):
        name = private if what == "jobs" else "secret"
        seen = {who: name in names(keyed, who, what) for who in ("alice", "admin", "bob", "reader")}
        assert seen == {"alice": True, "admin": True, "bob": False, "reader": False}, what


def test_a_page_of_jobs_is_full_though_others_are_left_out(keyed):
    mine = [keyed.submit("bob").json()["id"] for _ in range(2)]
    for _ in range(3):
        keyed.submit("alice", private=True)
    page = keyed.http("bob", "GET", "/v1/jobs?page_size=2").json()
    assert {job["id"] for job in page["jobs"]} == set(mine)
    everything, token = [], ""
    while True:
        page = keyed.http("bob", "GET", f"/v1/jobs?page_size=1&page_token={token}").json()
        everything += [job["id"] for job in page["jobs"]]
        if not (token := page["next_page_token"]):
            break
    assert everything == [job["id"] for job in keyed.http("bob", "GET", "/v1/jobs").json()["jobs"]]


BODIES = {
    "render": {"pose": POSE},
    "slice": {"origin_mm": [0, 0, 0], "size_mm": [1, 1]},
    "scene}:localize": {"image": "", "start": POSE},
    "scene}:plan": {},
    "scene}:assess": {"poses": [POSE]},
    "scene}:label": {"into": "mine", "frames": [{"pose": POSE, "labels": ""}]},
    "scene}:label-by-map": {"into": "mine", "label_map": ""},
    "scene}:edit": {"into": "mine", "edits": [{"kind": "thin", "gaussian_count": 1}]},
}
MAKING = ("registration.put", "dataset.upload", "recording.begin")
NAMING = [
    ("POST", "/v1/jobs", {"kind": "train", "specification": {"dataset": "{name}", "scene": "mine"}}),
    ("POST", "/v1/jobs", {"kind": "render", "specification": {"scene": "{name}", "poses": [MATRIX]}}),
    ("POST", "/v1/jobs", {"kind": "evaluate", "specification": {"scene": "{name}", "dataset": "{name}"}}),
    ("POST", "/v1/jobs", {"kind": "compare", "specification": {"dataset": "{name}"}}),
    ("POST", "/v1/jobs", {"kind": "voxelize", "specification": {"scene": "{name}", "spacing_mm": 1}}),
    ("POST", "/v1/jobs:estimate", {"kind": "render", "specification": {"scene": "{name}", "poses": [MATRIX]}}),
    ("PUT", "/v1/registrations/mine", {"scene": "{name}", "base_to_scene": MATRIX}),
    ("POST", "/v1/scenes/demo/render", {"pose": POSE, "registration": "{name}"}),
]
PRIVATE = (Kind.SCENE, Kind.DATASET, Kind.REGISTRATION)


def requests_about(name):
    """Of each route that a thing can be asked for by its name, and of those that take the name in their body."""
    named = dict.fromkeys([kind.value for kind in PRIVATE], name) | {"index": 0, "what": "truth", "part": "train"}
    for method, template, operation in HttpRules().routes():
        makes = method == "PUT" or template.endswith(":simulate")
        if operation.about in PRIVATE and not makes and method != WEBSOCKET:
            body = next((one for end, one in BODIES.items() if template.endswith(end)), None)
            yield method, template.format(**named), body
    for method, path, body in NAMING:
        yield method, path, json.loads(json.dumps(body).replace("{name}", name))


def test_private_things_answer_at_every_route_as_if_they_were_not_there(keyed, private):
    def ask(name):
        for method, path, body in requests_about(name):
            answer = keyed.http("bob", method, path, json=body)
            yield f"{method} {path} {answer.status_code} {dict(answer.json(), request_id='')}".replace(name, "NAME")

    told = list(ask("secret"))
    absent = list(ask("absent"))
    assert not [one for one in (*told, *absent) if FIRST in one]
    assert told == absent
    assert not [one for one in told if " 404 " not in one]


def test_a_private_scene_has_no_stream_for_others(keyed, private):
    with pytest.raises(InvalidStatus) as refused:
        connect(keyed.service.stream_url("secret"), additional_headers=keyed.headers("bob"))
    assert refused.value.response.status_code == 404


JOB_ROUTES = [
    ("GET", ""),
    ("GET", "/log"),
    ("GET", "/events"),
    ("GET", "/curve"),
    ("GET", "/preview"),
    ("GET", "/artifacts/x"),
    ("POST", ":cancel"),
    ("POST", ":retry"),
    ("DELETE", ""),
]


@pytest.mark.parametrize(("method", "suffix"), JOB_ROUTES)
def test_private_jobs_answer_as_if_they_were_not_there(keyed, private, method, suffix):
    def ask(job):
        answer = keyed.http("bob", method, f"/v1/jobs/{job}{suffix}")
        return answer.status_code, str({**answer.json(), "request_id": ""}).replace(job, "JOB")

    assert ask(private) == ask("0" * 24)
    assert ask(private)[0] == 404


def test_names_of_private_things_are_taken_all_the_same(keyed, private, scene_bytes, dataset_bytes):
    for answer, reason in (
        (keyed.http("bob", "PUT", "/v1/scenes/secret", content=scene_bytes), "SCENE_EXISTS"),
        (keyed.http("bob", "PUT", "/v1/datasets/secret", content=dataset_bytes), "DATASET_EXISTS"),
    ):
        assert (answer.status_code, answer.json()["reason"]) == (409, reason)
    assert keyed.http("alice", "GET", "/v1/scenes/secret").json()["owner"] == "alice"
    assert keyed.http("alice", "GET", "/v1/datasets/secret").json()["owner"] == "alice"


def test_a_private_job_that_is_in_the_way_is_not_named(keyed, scene_bytes, dataset_bytes):
    assert keyed.http("bob", "PUT", "/v1/datasets/lent", content=dataset_bytes).status_code == 201
    for private, scene in ((True, "hush"), (False, "told")):
        body = {"kind": "train", "specification": {"dataset": "lent", "scene": scene}, "private": private}
        job = keyed.http("alice", "POST", "/v1/jobs", json=body).json()["id"]
        for method, path, content, reason in (
            ("DELETE", "/v1/datasets/lent", None, "DATASET_IN_USE"),
            ("PUT", f"/v1/scenes/{scene}", scene_bytes, "SCENE_EXISTS"),
        ):
            answer = keyed.http("bob", method, path, content=content)
            assert (answer.status_code, answer.json()["reason"]) == (409, reason)
            assert (job in answer.json()["detail"]) is not private, answer.json()
        assert keyed.http("alice", "POST", f"/v1/jobs/{job}:cancel").status_code == 200


def test_metrics_name_no_private_scene(keyed, private):
    for _ in range(2):
        assert keyed.http("alice", "POST", "/v1/scenes/secret/render", json={"pose": POSE}).status_code == 200
    told = keyed.http("reader", "GET", "/metrics").text
    assert 'ultragray_frames_total{role="operator",scene=":private"} 2.0' in told
    assert "secret" not in told


def test_private_things_answer_at_every_method_as_if_they_were_not_there(keyed, private):
    pose = geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=[float(one) for row in MATRIX for one in row]))
    plane = {"origin_mm": geometry_pb2.Position(), "size_mm": rendering_pb2.SliceSize(width=1, height=1)}
    given = {"pose": pose, "start": pose, "poses": [pose], "slice": rendering_pb2.SliceSettings(**plane)}
    edit = scenes_pb2.Edit(thin=scenes_pb2.ThinEdit(gaussian_count=1))
    given |= {"into": "mine", "frames": [scenes_pb2.PaintedFrame(pose=pose)], "edits": [edit]}

    def ask(channel, name, job):
        things = {**given, **dict.fromkeys([kind.value for kind in PRIVATE], name), "job": job}
        for method, operation in GRPC_OPERATIONS.items():
            if operation.about in (*PRIVATE, Kind.JOB) and operation.name not in MAKING:
                told = call(channel, method, things, tuple(keyed.headers("bob").items()))
                told = told.details() if isinstance(told, grpc.RpcError) else str(told)
                told = re.sub(r"sent_ns: \d+", "", told)
                yield f"{method} {told}".replace(name, "NAME").replace(job, "JOB")

    with keyed.service.channel() as channel:
        told = list(ask(channel, "secret", private))
        assert told == list(ask(channel, "absent", "0" * 24))
    assert not [one for one in told if "there is no" not in one]


def test_a_key_tells_whose_it_is(keyed):
    answer = keyed.http("reader", "GET", "/v1/me").json()
    assert (answer["name"], answer["role"], answer["key_required"]) == ("reader", "reader", True)
    assert answer["expires_at"].startswith("20")


def test_others_things_can_be_read_and_not_changed(keyed, scene_bytes):
    assert keyed.http("alice", "PUT", "/v1/scenes/shared", content=scene_bytes).status_code == 201
    assert keyed.http("reader", "POST", "/v1/scenes/shared/render", json={"pose": POSE}).status_code == 200
    refused = keyed.http("bob", "DELETE", "/v1/scenes/shared")
    assert (refused.status_code, refused.json()["reason"]) == (403, "PERMISSION_DENIED")
    assert "the scene 'shared' is alice's" in refused.json()["detail"]
    assert keyed.http("alice", "DELETE", "/v1/scenes/shared").status_code == 204
    assert keyed.http("bob", "PUT", "/v1/scenes/shared", content=scene_bytes).json()["owner"] == "bob"


def test_a_scene_that_a_job_makes_is_its_owners(keyed, private):
    specification = {"dataset": "secret", "scene": "trained"}
    body = {"kind": "train", "specification": specification, "private": True}
    assert keyed.http("alice", "POST", "/v1/jobs", json=body).status_code == 201
    folder = keyed.service.data_folder
    published = folder / "trained.ugr"  # as a worker would, in the folder of scenes
    published.write_bytes((folder / "demo.ugr").read_bytes())
    try:
        wait_until(lambda: keyed.http("alice", "GET", "/v1/scenes/trained").json()["owner"] == "alice")
        assert keyed.http("bob", "GET", "/v1/scenes/trained").status_code == 404
    finally:
        published.unlink()


def test_a_request_id_of_a_deleted_job_shows_nobody_the_private_job_of_another(keyed):
    first = keyed.submit("bob", request_id="run-1").json()["id"]
    assert keyed.http("bob", "GET", f"/v1/jobs/{first}").status_code == 200
    assert keyed.http("bob", "POST", f"/v1/jobs/{first}:cancel").status_code == 200
    assert keyed.http("bob", "DELETE", f"/v1/jobs/{first}").status_code == 204
    second = keyed.submit("alice", request_id="run-1", private=True).json()["id"]
    for who in ("bob", "reader"):
        assert keyed.http(who, "GET", f"/v1/jobs/{second}").status_code == 404
    assert keyed.http("alice", "POST", f"/v1/jobs/{second}:cancel").status_code == 200


def test_a_request_id_with_another_private_asks_for_something_else(keyed):
    for first in (False, True):
        assert keyed.submit("alice", request_id=f"changes {first}", private=first).status_code == 201
        answer = keyed.submit("alice", request_id=f"changes {first}", private=not first)
        assert (answer.status_code, answer.json()["reason"]) == (409, "REQUEST_ID_CONFLICT")


def test_a_job_on_something_private_is_private(keyed, private):
    by_scene = keyed.submit("alice", scene="secret", request_id="on secret")
    body = {"kind": "train", "specification": {"dataset": "secret", "scene": "of-secret"}}
    for answer in (by_scene, keyed.http("alice", "POST", "/v1/jobs", json=body)):
        assert (answer.status_code, answer.json()["private"]) == (201, True)
        assert keyed.http("bob", "GET", f"/v1/jobs/{answer.json()['id']}").status_code == 404
    assert keyed.submit("alice", scene="secret", request_id="on secret").status_code == 200


@pytest.mark.long
def test_a_retry_uses_nothing_that_the_owner_of_the_job_may_not_see(keyed, dataset_bytes):
    assert keyed.http("bob", "PUT", "/v1/datasets/swap", content=dataset_bytes).status_code == 201
    body = {"kind": "train", "specification": {"dataset": "swap", "scene": "swapped"}}
    job = keyed.http("bob", "POST", "/v1/jobs", json=body).json()["id"]
    assert keyed.http("bob", "POST", f"/v1/jobs/{job}:cancel").status_code == 200
    assert keyed.http("bob", "DELETE", "/v1/datasets/swap").status_code == 204
    assert keyed.http("alice", "PUT", "/v1/datasets/swap?private=true", content=dataset_bytes).status_code == 201
    for who in ("bob", "admin"):
        answer = keyed.http(who, "POST", f"/v1/jobs/{job}:retry")
        assert (answer.status_code, answer.json()["reason"]) == (404, "DATASET_NOT_FOUND")
    assert keyed.http("alice", "DELETE", "/v1/datasets/swap").status_code == 204
    assert keyed.http("bob", "PUT", "/v1/datasets/swap", content=dataset_bytes).status_code == 201
    retried = keyed.http("admin", "POST", f"/v1/jobs/{job}:retry")
    assert (retried.status_code, retried.json()["owner"]) == (201, "bob")


ARM = "/v1/registrations/alices-arm"


def seen(keyed):
    """The status of asking for it, and whether it is in the list."""
    return {
        who: (keyed.http(who, "GET", ARM).status_code, "alices-arm" in names(keyed, who, "registrations"))
        for who in ("alice", "admin", "bob", "reader")
    }


@pytest.mark.parametrize("private", ["true", "false"])
def test_it_stays_private_when_its_scene_is_deleted_and_another_takes_the_name(keyed, scene_bytes, private):
    scene = "/v1/scenes/patient-42"
    assert keyed.http("alice", "PUT", f"{scene}?private=true", content=scene_bytes).status_code == 201
    body = {"scene": "patient-42", "base_to_scene": MATRIX, "probe_to_flange": MATRIX}
    assert keyed.http("alice", "PUT", ARM, json=body).status_code == 200
    as_before = {"alice": (200, True), "admin": (200, True), "bob": (404, False), "reader": (404, False)}
    assert seen(keyed) == as_before
    assert keyed.http("alice", "DELETE", scene).status_code == 204
    assert seen(keyed) == as_before
    request = {"pose": {"matrix": MATRIX}, "registration": "alices-arm"}
    refused = keyed.http("bob", "POST", "/v1/scenes/demo/render", json=request)
    assert (refused.status_code, refused.json()["reason"]) == (404, "REGISTRATION_NOT_FOUND")
    assert "patient-42" not in refused.text
    assert keyed.http("bob", "PUT", f"{scene}?private={private}", content=scene_bytes).status_code == 201
    assert seen(keyed) == as_before
    if private == "false":
        assert keyed.http("alice", "POST", f"{scene}/render", json=request).status_code == 200
    refused = keyed.http("bob", "POST", f"{scene}/render", json=request)
    assert (refused.status_code, refused.json()["reason"]) == (404, "REGISTRATION_NOT_FOUND")
    assert keyed.http("alice", "DELETE", ARM).status_code == 204
    assert keyed.http("bob", "DELETE", scene).status_code == 204


@pytest.mark.parametrize("replaced", [False, True], ids=["new", "in place of another's"])
def test_one_that_an_admin_puts_for_a_private_scene_is_for_its_owner_too(keyed, scene_bytes, replaced):
    scene, body = "/v1/scenes/patient-43", {"scene": "demo", "base_to_scene": MATRIX, "probe_to_flange": MATRIX}
    assert keyed.http("alice", "PUT", f"{scene}?private=true", content=scene_bytes).status_code == 201
    if replaced:
        assert keyed.http("bob", "PUT", ARM, json=body).status_code == 200
    assert keyed.http("admin", "PUT", ARM, json={**body, "scene": "patient-43"}).status_code == 200
    assert seen(keyed) == {"alice": (200, True), "admin": (200, True), "bob": (404, False), "reader": (404, False)}
    assert keyed.http("alice", "GET", ARM).json()["owner"] == "admin"
    assert keyed.http("bob", "DELETE", ARM).status_code == 404
    assert keyed.http("bob", "PUT", ARM, json=body).status_code == 403
    assert keyed.http("admin", "DELETE", ARM).status_code == 204
    assert keyed.http("alice", "DELETE", scene).status_code == 204


@pytest.fixture
def database(keyed):
    opened = JobDatabase(keyed.artifact_folder, None)
    yield opened
    with opened.engine.begin() as connection:
        connection.execute(sa.delete(WORKERS))
    opened.close()


def let_work(database, name, job):
    """A worker that goes on living, at work on a job, as its heartbeat would write it."""
    with database.engine.begin() as connection:
        facts = {"seen_at_s": time.time() + 3600.0, "host": "bench", "pid": 7, "device": "cpu", "version": "1"}
        connection.execute(sa.insert(WORKERS).values(name=name, job=job, **facts))


def told_workers(keyed, who):
    answer = keyed.http(who, "GET", "/v1/workers").json()
    return {worker["name"]: (worker["state"], worker["job"]) for worker in answer["workers"]}


def test_of_a_private_job_others_see_only_that_a_worker_is_busy(keyed, database):
    secret = keyed.submit("alice", private=True).json()["id"]
    shared = keyed.submit("alice").json()["id"]
    for name, job in {"one": secret, "two": shared, "three": None, "four": "0" * 24}.items():
        let_work(database, name, job)
    common = {"two": ("working", shared), "three": ("idle", None), "four": ("working", None)}
    for who, seen in {"alice": secret, "admin": secret, "bob": None, "reader": None}.items():
        assert told_workers(keyed, who) == {"one": ("working", seen), **common}, who


def test_admins_pause_drain_and_resume_over_http(keyed, database):
    let_work(database, "one", None)
    for wish, state in (("pause", "paused"), ("drain", "drained"), ("resume", "idle")):
        answer = keyed.http("admin", "POST", f"/v1/workers/one:{wish}")
        assert (answer.status_code, answer.json()["state"]) == (200, state)
        assert told_workers(keyed, "reader") == {"one": (state, None)}
        refused = keyed.http("alice", "POST", f"/v1/workers/one:{wish}")
        assert (refused.status_code, refused.json()["reason"]) == (403, "PERMISSION_DENIED")
        assert f"worker.{wish} needs the role admin, and alice has operator" in refused.json()["detail"]
        absent = keyed.http("admin", "POST", f"/v1/workers/absent:{wish}")
        assert (absent.status_code, absent.json()["reason"]) == (404, "WORKER_NOT_FOUND")

    def audited():
        found = entries(keyed.artifact_folder, "--what", "worker")
        return {(one["who"], one["what"], one["target"], one["result"]) for one in found}

    for wish in ("pause", "drain", "resume"):
        expected = {
            ("admin", f"worker.{wish}", "one", "OK"),
            ("alice", f"worker.{wish}", "one", "PERMISSION_DENIED"),
            ("admin", f"worker.{wish}", "absent", "WORKER_NOT_FOUND"),
        }
        wait_until(lambda expected=expected: expected <= audited())


def test_a_private_scene_is_not_merged_into_somebody_elses(keyed, scene_bytes):
    for name, private in (("hidden-half", "?private=true"), ("open-half", "")):
        answer = keyed.http("alice", "PUT", f"/v1/scenes/{name}{private}", content=scene_bytes)
        assert answer.status_code == 201
    body = {"into": "both-halves", "edits": [{"kind": "merge", "scene": "hidden-half", "fit_steps": 0}]}
    refused = keyed.http("bob", "POST", "/v1/scenes/open-half:edit", json=body)
    assert (refused.status_code, refused.json()["reason"]) == (404, "SCENE_NOT_FOUND")
    assert keyed.http("alice", "POST", "/v1/scenes/open-half:edit", json=body).status_code == 201


def test_labels_are_put_into_a_scene_by_its_owner_alone(keyed, scene_bytes):
    assert keyed.http("alice", "PUT", "/v1/scenes/labelled", content=scene_bytes).status_code == 201
    labels = cv2.imencode(".png", np.ones((32, 32), np.uint8))[1].tobytes()
    frame = {"pose": {"matrix": MATRIX}, "labels": base64.b64encode(labels).decode()}
    body = {"into": "labelled", "replace": True, "frames": [frame], "label_names": {"1": "tissue"}}
    refused = keyed.http("bob", "POST", "/v1/scenes/labelled:label", json=body)
    assert (refused.status_code, refused.json()["reason"], refused.json()["field"]) == (
        403,
        "PERMISSION_DENIED",
        "scene",
    )
    assert keyed.http("bob", "GET", "/v1/scenes/labelled").json()["label_names"] == {}
    answer = keyed.http("alice", "POST", "/v1/scenes/labelled:label", json=body)
    assert (answer.status_code, answer.json()["owner"]) == (201, "alice"), answer.text
    assert keyed.http("bob", "GET", "/v1/scenes/labelled").json()["label_names"] == {"1": "tissue"}
    own = keyed.http("bob", "POST", "/v1/scenes/labelled:label", json={**body, "into": "bobs", "private": True})
    assert (own.status_code, own.json()["owner"], own.json()["private"]) == (201, "bob", True), own.text
    assert keyed.http("alice", "GET", "/v1/scenes/bobs").status_code == 404
