"""Keys: made and revoked by the command line while a service runs, sent in one way, and whose they are."""

import base64
import json
import socket
import time
from functools import partial
from urllib.parse import urlsplit

import grpc
import httpx
import pytest
import sqlalchemy as sa
from grpc_health.v1 import health_pb2, health_pb2_grpc
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from ultragray.errors import InvalidArgument
from ultragray_proto.v1 import access_pb2, access_pb2_grpc
from ultragray_service.access.credentials import EnvironmentKeys, Guard
from ultragray_service.access.keys import KeyStore, KnownKeys, Snapshot
from ultragray_service.access.principals import LOCAL, Principal, Role
from ultragray_service.errors import Unauthenticated
from ultragray_workers.errors import DatabaseUnavailable
from ultragray_workers.jobs import tables
from ultragray_workers.jobs.database import JobDatabase

from ...waiting import wait_until
from ..cli.command_line import run

FIXED_KEY = "0123456789abcdef"


class Listed:
    """A source that knows what it is told."""

    def __init__(self, **principals):
        self.principals = principals

    @property
    def is_used(self):
        return bool(self.principals)

    def authenticate(self, credential):
        return self.principals.get(credential)


def test_roles_include_those_before_them():
    assert [[one.includes(other) for other in Role] for one in Role] == [
        [True, False, False],
        [True, True, False],
        [True, True, True],
    ]


def test_without_a_source_everybody_is_local():
    assert Guard([EnvironmentKeys(())]).authenticate(None) is LOCAL


def test_the_first_source_that_knows_a_credential_says_whose_it_is():
    alice = Principal("alice", Role.READER, "0badcafe")
    guard = Guard([Listed(alpha=alice), EnvironmentKeys([FIXED_KEY])])
    assert guard.authenticate("alpha") is alice
    assert guard.authenticate(FIXED_KEY) == Principal("environment:1", Role.ADMIN, "environment")


def test_a_credential_counts_until_it_expires():
    def guard(expires_at_s):
        return Guard([Listed(alpha=Principal("alice", Role.READER, "0badcafe", expires_at_s))])

    assert guard(time.time() + 60).authenticate("alpha").name == "alice"
    with pytest.raises(Unauthenticated, match="alice has expired"):
        guard(time.time()).authenticate("alpha")


def test_a_source_that_lost_its_credentials_opens_no_door():
    source = Listed(alpha=Principal("alice", Role.READER, "0badcafe"))
    guard = Guard([source])
    guard.authenticate("alpha")
    source.principals.clear()
    for credential in ("alpha", None):
        with pytest.raises(Unauthenticated):
            guard.authenticate(credential)


KEY, OTHER = "0123456789abcdef-one", "0123456789abcdef-two"


@pytest.fixture(scope="module")
def guarded(start_service):
    return start_service(api_keys=f"{KEY},{OTHER}")


@pytest.mark.parametrize(
    ("headers", "is_known"),
    [
        ([("x-api-key", KEY)], True),
        ([("authorization", f"Bearer {KEY}")], True),
        ([("authorization", f"bearer {OTHER}")], True),
        ([("authorization", f"Basic {KEY}")], False),
        ([("x-api-key", KEY[:-1])], False),
        ([("x-api-key", KEY), ("authorization", "Basic of-a-proxy")], True),
        ([("x-api-key", KEY), ("x-api-key", KEY)], False),
        ([("x-api-key", KEY), ("x-api-key", "unknown")], False),
        ([("x-api-key", "unknown"), ("x-api-key", KEY)], False),
        ([("authorization", f"Bearer {KEY}"), ("authorization", f"Bearer {OTHER}")], False),
        ([("x-api-key", ""), ("authorization", f"Bearer {KEY}")], False),
        ([("x-api-key", "")], False),
        ([], False),
    ],
)
def test_both_doors_take_the_same(guarded, headers, is_known):
    status = httpx.get(f"{guarded.http}/v1/me", headers=headers, timeout=300).status_code
    assert status == (200 if is_known else 401)
    with guarded.channel() as channel:
        stub = access_pb2_grpc.AccessServiceStub(channel)
        call = stub.WhoAmI.future(access_pb2.WhoAmIRequest(), metadata=headers, timeout=300)
        assert call.code() is (grpc.StatusCode.OK if is_known else grpc.StatusCode.UNAUTHENTICATED)


@pytest.mark.parametrize(
    ("offered", "status"),
    [
        (b"ultragray.v1, ultragray.key.\xe9", 400),
        (b"ultragray.v1, ultragray.key.!!/!", 400),
        (b"ultragray.v1, ultragray.key.A", 401),
        (b"ultragray.v1, ultragray.key.%s, ultragray.key.%s" % (2 * (base64.urlsafe_b64encode(KEY.encode()),)), 400),
    ],
)
def test_subprotocols_that_are_none_are_refused_with_a_problem(guarded, offered, status):
    parts = urlsplit(guarded.http)
    with socket.create_connection((parts.hostname, parts.port), timeout=300) as connection:
        connection.sendall(
            b"GET /v1/scenes/demo/stream HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Protocol: " + offered + b"\r\n\r\n"
        )
        answer = b""
        while block := connection.recv(65536):
            answer += block
    head = answer.partition(b"\r\n\r\n")[0].lower()
    assert head.startswith(b"http/1.1 %d " % status)
    assert b"content-type: application/problem+json" in head


def test_a_page_sends_its_key_as_a_subprotocol(guarded):
    with pytest.raises(InvalidStatus) as refused, connect(guarded.stream_url()):
        pass
    assert refused.value.response.status_code == 401
    offered = "ultragray.key." + base64.urlsafe_b64encode(KEY.encode()).decode().rstrip("=")
    with connect(guarded.stream_url(), subprotocols=["ultragray.v1", offered]) as connection:
        assert connection.subprotocol == "ultragray.v1"


def test_health_lists_every_service_without_a_key(guarded):
    with guarded.channel() as channel:
        stub = health_pb2_grpc.HealthStub(channel)

        def is_serving(name):
            statuses = stub.List(health_pb2.HealthListRequest(), timeout=300).statuses
            return bool(statuses[name].status == health_pb2.HealthCheckResponse.SERVING)

        for name in ("", "ultragray.v1.RenderService", "ultragray.v1.SceneService"):
            wait_until(partial(is_serving, name))  # it follows the service a moment later
        check = channel.unary_unary("/grpc.health.v1.Health/Check")
        with pytest.raises(grpc.RpcError) as caught:
            check(b"\xff\xff", timeout=300)
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT
    assert "Traceback" not in guarded.log_path.read_text()


def test_refusals_say_how_to_authenticate_and_health_and_documentation_stay_open(guarded):
    for path in ("/v1/scenes", "/metrics", "/v1/nothing"):
        answer = httpx.get(f"{guarded.http}{path}", timeout=300)
        assert (answer.status_code, answer.json()["reason"]) == (401, "UNAUTHENTICATED")
        assert answer.headers["www-authenticate"] == "Bearer"
    for path in ("/v1/health/live", "/v1/health/ready", "/docs"):
        assert httpx.get(f"{guarded.http}{path}", timeout=300).status_code == 200
    document = httpx.get(f"{guarded.http}/openapi.json", timeout=300).json()
    assert set(document["components"]["securitySchemes"]) == {"Bearer", "ApiKey"}
    assert KEY not in guarded.log_path.read_text()


@pytest.fixture
def database_url(new_database):
    return new_database()


@pytest.fixture
def database(tmp_path, database_url):
    opened = JobDatabase(tmp_path, database_url)
    yield opened
    opened.close()


def keys(folder, *arguments):
    return run("keys", *arguments, "--artifact-folder", folder)


def test_a_key_is_known_by_its_secret_which_is_nowhere_kept(database):
    store, known = KeyStore(database.engine), KnownKeys()
    key, secret = store.create("alice", Role.OPERATOR, 90.0)
    known.replace(store.keys())
    assert known.authenticate(secret) == Principal("alice", Role.OPERATOR, key.id, key.expires_at_s)
    assert known.authenticate(secret[:-1]) is None
    assert len(secret) >= 43  # 256 bits
    with database.engine.connect() as connection:
        row = connection.execute(sa.select(tables.KEYS)).one()
    assert secret not in str(row)
    assert row.expires_at_s - row.created_at_s == pytest.approx(90 * 86400)


def test_revoking_a_name_revokes_all_its_keys_and_an_id_one(database):
    store = KeyStore(database.engine)
    first, _ = store.create("alice", Role.READER, None)
    second, secret = store.create("alice", Role.ADMIN, None)
    other, _ = store.create("bob", Role.READER, None)
    assert [key.id for key in store.revoke(first.id)] == [first.id]
    assert [key.id for key in store.revoke("alice")] == [second.id]
    assert store.revoke("alice") == []
    with pytest.raises(InvalidArgument, match="no key of the name or id 'carol'"):
        store.revoke("carol")
    known = KnownKeys()
    known.replace(store.keys())
    with pytest.raises(Unauthenticated, match="was revoked"):
        known.authenticate(secret)
    assert [key.id for key in store.keys().values() if key.is_valid(time.time())] == [other.id]


@pytest.mark.parametrize("name", ["", "oidc:alice", "a b", "-", "x" * 65, "local:"])
def test_names_that_other_sources_may_give_are_refused(database, name):
    with pytest.raises(InvalidArgument, match="name must be"):
        KeyStore(database.engine).create(name, Role.READER, None)


def test_a_snapshot_follows_the_keys_and_writes_when_they_were_used(database):
    store, known = KeyStore(database.engine), KnownKeys()
    snapshot = Snapshot(database.engine, known, ())
    try:
        assert not known.is_used
        key, secret = store.create("alice", Role.READER, None)
        wait_until(lambda: known.authenticate(secret) is not None)
        store.note_uses(known.take_uses())
        (kept,) = store.keys().values()
        assert kept.id == key.id
        assert kept.last_used_at_s == pytest.approx(time.time(), abs=60)
    finally:
        snapshot.close()


def test_a_snapshot_outlives_the_database(tmp_path, postgres):
    database = JobDatabase(tmp_path, postgres.create_database())
    store, known = KeyStore(database.engine), KnownKeys()
    _, secret = store.create("alice", Role.READER, None)
    snapshot = Snapshot(database.engine, known, ())
    try:
        postgres.stop()
        try:
            with pytest.raises(DatabaseUnavailable):
                snapshot.refresh()
            assert known.authenticate(secret) is not None
        finally:
            postgres.start()
        store.revoke("alice")

        def is_revoked():
            try:
                return known.authenticate(secret) is None
            except Unauthenticated:
                return True

        wait_until(is_revoked)
    finally:
        snapshot.close()
        database.close()


def test_keys_are_made_and_revoked_without_a_restart(start_service, tmp_path):
    service = start_service(artifact_folder=tmp_path)
    routes = f"{service.http}/v1/scenes"
    assert httpx.get(routes, timeout=300).status_code == 200

    made = keys(tmp_path, "create", "alice", "--role", "reader", "--expires-days", "90")
    assert made.exit_code == 0, made.stderr
    assert made.stdout.count("\n") == 1  # alone, for scripts
    assert "alice" in made.stderr
    assert made.stdout.strip() not in made.stderr
    headers = {"Authorization": f"Bearer {made.stdout.strip()}"}
    wait_until(lambda: httpx.get(routes, timeout=300).status_code == 401)  # from the first key on
    assert httpx.get(routes, headers=headers, timeout=300).status_code == 200

    (listed,) = json.loads(keys(tmp_path, "list", "--json").stdout)
    assert (listed["name"], listed["role"], listed["state"]) == ("alice", "reader", "valid")
    assert made.stdout.strip() not in json.dumps(listed)
    assert keys(tmp_path, "revoke", "alice").exit_code == 0
    wait_until(lambda: httpx.get(routes, headers=headers, timeout=300).status_code == 401)
    assert "revoked" in keys(tmp_path, "list").stdout
    assert keys(tmp_path, "revoke", "nobody").exit_code == 2
