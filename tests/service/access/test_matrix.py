"""Every route and method, asked for with every kind of key: what the rules say is what happens."""

import json

import grpc
import numpy as np
import pytest
from google.protobuf.message_factory import GetMessageClass
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from ultragray_proto.v1 import (
    access_pb2,
    datasets_pb2,
    jobs_pb2,
    recordings_pb2,
    registrations_pb2,
    rendering_pb2,
    scenes_pb2,
    workers_pb2,
)
from ultragray_service.access.rules import GRPC_OPERATIONS, WEBSOCKET, HttpRules, Operation, require_all_methods
from ultragray_service.http import app as http_app
from ultragray_service.http.app import create_app
from ultragray_service.settings import Settings
from ultragray_service.wiring import make_service

from ..rpc.test_grpc_render import error_info
from .conftest import ROLES

STRANGERS = ("nobody", "wrong", "expired", "revoked")
METHODS = {
    f"/{service.full_name}/{method.name}": method
    for module in (
        *(scenes_pb2, rendering_pb2, datasets_pb2, recordings_pb2),
        *(jobs_pb2, access_pb2, workers_pb2, registrations_pb2),
    )
    for service in module.DESCRIPTOR.services_by_name.values()
    for method in service.methods
}


def refusal(operation, who):
    """The reason of the refusal that the rules want; None: it goes on, whatever becomes of it."""
    if operation.role is None:
        return None
    if who in STRANGERS:
        return "UNAUTHENTICATED"
    if not ROLES[who].includes(operation.role):
        return "PERMISSION_DENIED"
    return "PERMISSION_DENIED" if operation.owned and who not in ("alice", "admin") else None


def in_order(operations):
    """What takes things away comes last, so that all else finds them; scenes at the end, with which others hide."""
    return sorted(operations, key=lambda one: (one[2].owned, one[0] == "DELETE", one[1].startswith("/v1/scenes")))


@pytest.fixture
def things(keyed, scene_bytes, dataset_bytes):
    """A scene, a dataset, a job and a registration of alice's; a test may delete them."""
    job = keyed.submit("alice")
    assert job.status_code == 201, job.text
    assert keyed.http("alice", "PUT", "/v1/scenes/hers", content=scene_bytes).status_code in (201, 409)
    assert keyed.http("alice", "PUT", "/v1/datasets/hers", content=dataset_bytes).status_code in (200, 201)
    registration = {"scene": "hers", "base_to_scene": np.eye(4).tolist()}
    assert keyed.http("alice", "PUT", "/v1/registrations/hers", json=registration).status_code == 200
    named = dict.fromkeys(("scene", "dataset", "registration"), "hers") | dict.fromkeys(("worker", "stream"), "absent")
    return {**named, "job": job.json()["id"]}


def ask(keyed, who, method, path):
    if method == WEBSOCKET:
        try:
            address = f"{keyed.service.http.replace('http', 'ws')}{path}"
            with connect(address, additional_headers=keyed.headers(who)):
                return 101, None
        except InvalidStatus as error:
            return error.response.status_code, json.loads(error.response.body)["reason"]
    with keyed.client.stream(method, path, headers=keyed.headers(who)) as answer:
        is_problem = answer.headers.get("content-type") == "application/problem+json"
        return answer.status_code, str(answer.read() and answer.json()["reason"]) if is_problem else None


def test_every_route_answers_everybody_as_the_rules_say(keyed, things):
    wrong = []
    for method, template, operation in in_order(HttpRules().routes()):
        path = template.replace(":path}", "}").format(
            **things, index=0, what="truth", part="train", name="x", path="swagger-ui.css"
        )
        for who in (*STRANGERS, "reader", "bob", "admin", "alice"):
            status, reason = ask(keyed, who, method, path)
            wanted = refusal(operation, who)
            refused = reason if status in (401, 403) else None
            if refused == "SCENE_READ_ONLY":
                refused = None
            if refused != wanted or (wanted and status != {"UNAUTHENTICATED": 401}.get(wanted, 403)):
                wrong.append((who, method, path, status, reason, wanted))
    assert not wrong, wrong


def test_every_method_answers_everybody_as_the_rules_say(keyed, things):
    wrong = []
    with keyed.service.channel() as channel:
        for name, operation in sorted(GRPC_OPERATIONS.items(), key=lambda one: (one[1].owned, "Delete" in one[0])):
            for who in (*STRANGERS, "reader", "bob", "admin", "alice"):
                reason = reason_of(call(channel, name, things, tuple(keyed.headers(who).items())))
                wanted = refusal(operation, who)
                if (reason if reason in ("UNAUTHENTICATED", "PERMISSION_DENIED") else None) != wanted:
                    wrong.append((who, name, reason, wanted))
    assert not wrong, wrong


def call(channel, name, things, metadata):
    """The first answer, None where none came in time, or the error."""
    method = METHODS[name]
    request, answers = GetMessageClass(method.input_type), GetMessageClass(method.output_type)
    given = {**things, "settings": rendering_pb2.RenderSettings(scene=things["scene"])}
    if name.endswith("/BeginRecording"):
        del given["settings"]  # its own: it goes on without
    request = request(**{field.name: given[field.name] for field in method.input_type.fields if field.name in given})
    kind = f"{'stream' if method.client_streaming else 'unary'}_{'stream' if method.server_streaming else 'unary'}"
    invoke = getattr(channel, kind)(name, type(request).SerializeToString, answers.FromString)
    answer = None
    try:
        answer = invoke(iter([request]) if method.client_streaming else request, metadata=metadata, timeout=300)
        return next(answer, None) if method.server_streaming else answer
    except grpc.RpcError as error:
        return error
    finally:
        if method.server_streaming and answer is not None:
            answer.cancel()


def reason_of(answer):
    """The reason of a refusal; None of an answer."""
    if not isinstance(answer, grpc.RpcError):
        return None
    is_ours = "grpc-status-details-bin" in dict(answer.trailing_metadata() or ())
    return error_info(answer)[0].reason if is_ours else answer.code().name


def test_rules_and_routes_are_the_same(tmp_path):
    create_app(make_service(Settings(data_folder=tmp_path)))  # which has a rule for each of its routes
    assert set(METHODS) == set(GRPC_OPERATIONS)


def test_a_route_without_a_rule_stops_the_start(tmp_path, monkeypatch):
    known = HttpRules().routes()
    kept = [Operation(one.name, one.role, (f"{method} {path}",)) for method, path, one in known if path != "/v1/jobs"]
    monkeypatch.setattr(http_app, "HttpRules", lambda: HttpRules(kept))
    with pytest.raises(LookupError, match=r"who may ask for \[\('GET', '/v1/jobs'\), \('POST', '/v1/jobs'"):
        create_app(make_service(Settings(data_folder=tmp_path)))
    with pytest.raises(LookupError, match="does not say who may call"):
        require_all_methods([*METHODS, "/ultragray.v1.SceneService/Paint"])
