from __future__ import annotations

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from ultragray_proto.v1 import scenes_pb2, scenes_pb2_grpc

from ..conftest import RunningService, StartService
from ..rpc.test_grpc_render import error_info

KEY, OTHER_KEY = "0123456789abcdef-first", "0123456789abcdef-second"


@pytest.fixture(scope="module")
def guarded(start_service: StartService) -> RunningService:
    return start_service(api_keys=f"{KEY}, {OTHER_KEY}")


@pytest.mark.parametrize(
    "headers",
    [{"Authorization": f"Bearer {KEY}"}, {"Authorization": f"bearer {OTHER_KEY}"}, {"X-API-Key": KEY}],
)
def test_a_known_key_opens_both_doors(guarded: RunningService, headers: dict[str, str]) -> None:
    assert httpx.get(f"{guarded.http}/v1/scenes", headers=headers, timeout=60).status_code == 200
    with guarded.channel() as channel:
        stub = scenes_pb2_grpc.SceneServiceStub(channel)
        metadata = tuple((key.lower(), value) for key, value in headers.items())
        assert stub.ListScenes(scenes_pb2.ListScenesRequest(), metadata=metadata).scenes


@pytest.mark.parametrize("headers", [{}, {"Authorization": f"Basic {KEY}"}, {"X-API-Key": KEY[:-1]}])
def test_no_key_or_another_opens_none(guarded: RunningService, headers: dict[str, str]) -> None:
    for path in ("/v1/scenes", "/metrics", "/v1/nothing"):
        answer = httpx.get(f"{guarded.http}{path}", headers=headers, timeout=60)
        assert (answer.status_code, answer.json()["reason"]) == (401, "UNAUTHENTICATED")
        assert answer.headers["www-authenticate"] == "Bearer"
    with guarded.channel() as channel:
        stub = scenes_pb2_grpc.SceneServiceStub(channel)
        metadata = tuple((key.lower(), value) for key, value in headers.items())
        with pytest.raises(grpc.RpcError) as caught:
            stub.ListScenes(scenes_pb2.ListScenesRequest(), metadata=metadata)
        assert caught.value.code() is grpc.StatusCode.UNAUTHENTICATED
        assert error_info(caught.value)[0].reason == "UNAUTHENTICATED"


def test_health_and_documentation_stay_open(guarded: RunningService) -> None:
    for path in ("/v1/health/live", "/v1/health/ready", "/docs"):
        assert httpx.get(f"{guarded.http}{path}", timeout=60).status_code == 200
    document = httpx.get(f"{guarded.http}/openapi.json", timeout=60).json()
    assert set(document["components"]["securitySchemes"]) == {"Bearer", "ApiKey"}
    with guarded.channel() as channel:
        answer = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest())
        assert answer.status == health_pb2.HealthCheckResponse.SERVING


def test_keys_are_not_logged(guarded: RunningService) -> None:
    assert KEY not in guarded.log_path.read_text()
