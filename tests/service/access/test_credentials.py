"""One key, sent in one way: what both doors take, and what neither does."""

from __future__ import annotations

import base64
import socket
from functools import partial
from urllib.parse import urlsplit

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from ultragray_proto.v1 import access_pb2, access_pb2_grpc

from ...waiting import wait_until
from ..conftest import RunningService, StartService

KEY, OTHER = "0123456789abcdef-one", "0123456789abcdef-two"


@pytest.fixture(scope="module")
def guarded(start_service: StartService) -> RunningService:
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
def test_both_doors_take_the_same(guarded: RunningService, headers: list[tuple[str, str]], is_known: bool) -> None:
    status = httpx.get(f"{guarded.http}/v1/me", headers=headers, timeout=60).status_code
    assert status == (200 if is_known else 401)
    with guarded.channel() as channel:
        stub = access_pb2_grpc.AccessServiceStub(channel)
        call = stub.WhoAmI.future(access_pb2.WhoAmIRequest(), metadata=headers, timeout=60)
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
def test_subprotocols_that_are_none_are_refused_with_a_problem(
    guarded: RunningService, offered: bytes, status: int
) -> None:
    parts = urlsplit(guarded.http)
    with socket.create_connection((parts.hostname, parts.port), timeout=60) as connection:
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


def test_health_lists_every_service_without_a_key(guarded: RunningService) -> None:
    with guarded.channel() as channel:
        stub = health_pb2_grpc.HealthStub(channel)

        def is_serving(name: str) -> bool:
            statuses = stub.List(health_pb2.HealthListRequest(), timeout=60).statuses
            return bool(statuses[name].status == health_pb2.HealthCheckResponse.SERVING)

        for name in ("", "ultragray.v1.RenderService"):
            wait_until(partial(is_serving, name))  # it follows the service a moment later
        check = channel.unary_unary("/grpc.health.v1.Health/Check")
        with pytest.raises(grpc.RpcError) as caught:
            check(b"\xff\xff", timeout=60)
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT
    assert "Traceback" not in guarded.log_path.read_text()


def test_refusals_say_how_to_authenticate_and_health_and_documentation_stay_open(guarded: RunningService) -> None:
    for path in ("/v1/scenes", "/metrics", "/v1/nothing"):
        answer = httpx.get(f"{guarded.http}{path}", timeout=60)
        assert (answer.status_code, answer.json()["reason"]) == (401, "UNAUTHENTICATED")
        assert answer.headers["www-authenticate"] == "Bearer"
    for path in ("/v1/health/live", "/v1/health/ready", "/docs"):
        assert httpx.get(f"{guarded.http}{path}", timeout=60).status_code == 200
    document = httpx.get(f"{guarded.http}/openapi.json", timeout=60).json()
    assert set(document["components"]["securitySchemes"]) == {"Bearer", "ApiKey"}
    assert KEY not in guarded.log_path.read_text()
