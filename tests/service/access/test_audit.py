"""The audit log of a service at work, and streams that end with their key."""

import json
import threading
import time

import grpc
import httpx
import pytest
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from ultragray_client import Client
from ultragray_client.errors import InvalidArgument, PermissionDenied
from ultragray_proto.v1 import geometry_pb2, jobs_pb2, jobs_pb2_grpc, rendering_pb2, rendering_pb2_grpc
from ultragray_service.access import audit
from ultragray_service.access.audit import MAX_WAITING, AuditLog, Entry, read_audit
from ultragray_service.access.keys import KeyStore
from ultragray_service.access.principals import Role
from ultragray_workers.jobs.database import JobDatabase

from ...waiting import wait_until
from ..cli.command_line import run
from .conftest import MATRIX, POSE


@pytest.fixture
def database(tmp_path):
    opened = JobDatabase(tmp_path, None)
    yield opened
    opened.close()


def entries(folder, *options):
    return json.loads(run("audit", "--json", "--artifact-folder", folder, *options).stdout)


def test_a_service_writes_who_did_what(start_service, tmp_path, database, scene_bytes):
    store = KeyStore(database.engine)
    _, alice = store.create("alice", Role.OPERATOR, None)
    _, reader = store.create("reader", Role.READER, None)
    service = start_service(artifact_folder=tmp_path)

    def ask(key, method, path, **options):
        headers = {"X-API-Key": key, "X-Forwarded-For": "203.0.113.7"}  # which says nothing
        return httpx.request(method, f"{service.http}{path}", headers=headers, timeout=300, **options)

    ask(alice, "PUT", "/v1/scenes/mine", content=scene_bytes)
    specification = {"scene": "demo", "poses": [MATRIX]}
    job = ask(alice, "POST", "/v1/jobs", json={"kind": "render", "specification": specification}).json()["id"]
    ask(reader, "DELETE", "/v1/scenes/mine")
    ask(reader, "DELETE", "/v1/scenes/mine")
    ask("wrong", "GET", "/v1/scenes")
    for _ in range(3):
        assert ask(reader, "POST", "/v1/scenes/demo/render", json={"pose": POSE}).status_code == 200
    ask(alice, "DELETE", "/v1/scenes/absent")
    pose = geometry_pb2.Pose(
        placement=geometry_pb2.Placement(position_mm=geometry_pb2.Position(), quaternion=geometry_pb2.Quaternion(w=1.0))
    )
    settings = rendering_pb2.RenderSettings(scene="demo")
    asked = [rendering_pb2.RenderStreamRequest(settings=settings, pose=pose) for _ in range(2)]
    with service.channel() as channel:
        stub = rendering_pb2_grpc.RenderServiceStub(channel)
        assert len(list(stub.RenderStream(iter(asked), metadata=(("x-api-key", reader),)))) == 2
    assert service.terminate() == 0  # which writes what is left

    found = [(one["who"], one["address"], one["what"], one["target"], one["result"]) for one in entries(tmp_path)]
    here = "127.0.0.1"
    for expected in (
        ("alice", here, "scene.import", "mine", "OK"),
        ("alice", here, "job.submit", job, "OK"),
        ("reader", here, "scene.delete", "mine", "PERMISSION_DENIED"),
        ("-", here, "scene.list", "", "UNAUTHENTICATED"),
        ("alice", here, "scene.delete", "absent", "SCENE_NOT_FOUND"),
        ("reader", here, "stream", "", "OPENED"),
        ("reader", here, "stream", "demo", "OK"),
        ("reader", here, "render", "demo", "OK"),
    ):
        assert expected in found
    counts = {
        (one["what"], one["result"]): one["facts"] for one in entries(tmp_path, "--who", "reader") if one["facts"]
    }
    assert counts["render", "OK"] == {"count": 3}
    assert counts["scene.delete", "PERMISSION_DENIED"] == {"count": 1}  # after the first
    assert dict(counts["stream", "OK"])["frames"] == 2
    assert {one["what"] for one in entries(tmp_path, "--what", "scene")} == {
        "scene.import",
        "scene.delete",
        "scene.list",
    }
    assert "scene.import" in run("audit", "--artifact-folder", tmp_path).stdout


def test_admins_read_the_log_at_both_doors(start_service, tmp_path, database):
    store = KeyStore(database.engine)
    keys = {role: store.create(role.value, role, None)[1] for role in (Role.READER, Role.ADMIN)}
    service = start_service(artifact_folder=tmp_path)

    def read(role, **query):
        headers = {"X-API-Key": keys[role]}
        return httpx.get(f"{service.http}/v1/audit", params=query, headers=headers, timeout=300)

    assert httpx.post(
        f"{service.http}/v1/scenes/demo:load", headers={"X-API-Key": keys[Role.ADMIN]}, timeout=300
    ).is_success

    def loads():
        return read(Role.ADMIN, what="scene.load", who="admin").json()["entries"]

    (entry,) = wait_until(loads)
    assert [entry[part] for part in ("who", "address", "what", "target")] == [
        "admin",
        "127.0.0.1",
        "scene.load",
        "demo",
    ]
    assert (entry["result"], entry["facts"]) == ("OK", {})
    assert str(entry["at"]).endswith("+00:00")
    assert read(Role.READER).status_code == 403
    for query in ({"limit": 0}, {"limit": 10_001}, {"since_hours": 0}):
        refused = read(Role.ADMIN, **query)
        assert (refused.status_code, refused.json()["field"]) == (422, next(iter(query)))
    with Client(service.grpc, api_key=keys[Role.ADMIN], timeout_s=300.0) as client:
        (told,) = client.audit(what="scene.load", who="admin")
        assert (told.at, told.what, told.target, told.facts) == (entry["at"], "scene.load", "demo", {})
        with pytest.raises(InvalidArgument, match="limit must be"):
            client.audit(limit=10_001)
    with Client(service.grpc, api_key=keys[Role.READER], timeout_s=300.0) as client, pytest.raises(PermissionDenied):
        client.audit()


@pytest.mark.long
def test_entries_wait_for_the_database_and_what_is_lost_is_counted(tmp_path, postgres):
    database = JobDatabase(tmp_path, postgres.create_database())
    log = AuditLog()
    log.open(database.engine)
    postgres.stop()
    try:
        for number in range(MAX_WAITING + 7):
            log.tell(Entry("alice", "::1", "scene.load", str(number), "OK"))
    finally:
        postgres.start()

    def lost():
        return read_audit(database.engine, since_s=0, what="audit", limit=10)

    (entry,) = wait_until(lost)
    assert entry.facts == {"count": 7}
    kept = read_audit(database.engine, since_s=0, what="scene", limit=MAX_WAITING + 10)
    assert [one.target for one in kept] == [str(number) for number in range(MAX_WAITING)]
    log.close()
    database.close()


def test_an_attacker_fills_no_log(database, monkeypatch):
    monkeypatch.setattr(audit, "WRITE_INTERVAL_S", 0.01)
    log = AuditLog()
    for number in range(5000):
        log.count(Entry("-", f"10.0.{number // 250}.{number % 250}", "scene.get", "x\0", "UNAUTHENTICATED"))
    log.open(database.engine)
    log.close()
    assert len(read_audit(database.engine, since_s=time.time() - 60, limit=10_000)) <= 1010


def test_each_name_has_room_of_its_own(database):
    log = AuditLog()
    for number in range(2000):
        log.count(Entry("alice", "::1", "scene.get", str(number), "RATE_LIMITED"))
    log.count(Entry("bob", "::1", "scene.delete", "demo", "PERMISSION_DENIED"))
    log.open(database.engine)
    log.close()
    found = read_audit(database.engine, since_s=0, limit=10_000)
    assert [one.target for one in found if one.who == "bob"] == ["demo"]
    assert sum(one.facts.get("count", 1) for one in found if one.who == "alice") == 2000


def test_streams_and_watches_end_with_their_key(start_service, tmp_path, database):
    store = KeyStore(database.engine)
    _, key = store.create("alice", Role.OPERATOR, None)
    service = start_service(artifact_folder=tmp_path)
    body = {"kind": "render", "specification": {"scene": "demo", "poses": [MATRIX]}}
    job = httpx.post(f"{service.http}/v1/jobs", headers={"X-API-Key": key}, json=body, timeout=300).json()["id"]
    address = service.stream_url()
    with service.channel() as channel, connect(address, additional_headers={"X-API-Key": key}) as socket:
        stub = jobs_pb2_grpc.JobServiceStub(channel)
        watch = stub.WatchJob(jobs_pb2.WatchJobRequest(job=job), metadata=(("x-api-key", key),))
        over = threading.Event()

        def asked():
            yield reflection_pb2.ServerReflectionRequest(list_services="*")
            over.wait(300)

        reflection = reflection_pb2_grpc.ServerReflectionStub(channel).ServerReflectionInfo
        names = reflection(asked(), metadata=(("x-api-key", key),))
        next(watch), next(names)
        store.revoke("alice")
        for call in (watch, names):
            with pytest.raises(grpc.RpcError) as refused:
                list(call)
            assert refused.value.code() is grpc.StatusCode.UNAUTHENTICATED
        over.set()
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(timeout=300)
        assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1008, "UNAUTHENTICATED")
