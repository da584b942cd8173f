from __future__ import annotations

from typing import Any

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from ultragray_proto.v1 import scenes_pb2, scenes_pb2_grpc

from ...waiting import wait_until
from ..conftest import RunningService
from .test_grpc_render import error_info

Stub = scenes_pb2_grpc.SceneServiceStub


def test_list_pages_and_tells_bad_files(scenes: Stub) -> None:
    first = scenes.ListScenes(scenes_pb2.ListScenesRequest(page_size=2))
    rest = scenes.ListScenes(scenes_pb2.ListScenesRequest(page_token=first.next_page_token))
    names = [entry.name for entry in (*first.scenes, *rest.scenes)]
    assert names == ["demo", "empty", "foreign", "probeless", "second", "truncated"]
    assert first.scenes[0].gaussian_count == 400
    assert not first.scenes[0].HasField("error")
    assert first.scenes[1].error.reason == "SCENE_FILE_INVALID"
    assert rest.next_page_token == ""


@pytest.mark.parametrize(
    ("scene", "code", "reason"),
    [
        ("nowhere", grpc.StatusCode.NOT_FOUND, "SCENE_NOT_FOUND"),
        ("", grpc.StatusCode.NOT_FOUND, "SCENE_NOT_FOUND"),
        ("foreign", grpc.StatusCode.FAILED_PRECONDITION, "SCENE_FILE_INVALID"),
    ],
)
def test_scenes_that_cannot_be_read(scenes: Stub, scene: str, code: Any, reason: str) -> None:
    calls = (
        lambda: scenes.GetScene(scenes_pb2.GetSceneRequest(scene=scene)),
        lambda: scenes.LoadScene(scenes_pb2.LoadSceneRequest(scene=scene)),
    )
    for call in calls:
        with pytest.raises(grpc.RpcError) as caught:
            call()
        info, _ = error_info(caught.value)
        assert (caught.value.code(), info.reason, info.metadata["field"]) == (code, reason, "scene")


def test_bad_pages(scenes: Stub) -> None:
    for request, field in (
        (scenes_pb2.ListScenesRequest(page_size=-1), "page_size"),
        (scenes_pb2.ListScenesRequest(page_token="*"), "page_token"),
    ):
        with pytest.raises(grpc.RpcError) as caught:
            scenes.ListScenes(request)
        assert error_info(caught.value)[0].metadata["field"] == field


def test_health_and_reflection(channel: grpc.Channel) -> None:
    health = health_pb2_grpc.HealthStub(channel)
    for name in ("", "ultragray.v1.RenderService", "ultragray.v1.SceneService"):
        request = health_pb2.HealthCheckRequest(service=name)

        def is_serving(request: health_pb2.HealthCheckRequest = request) -> bool:
            status = health.Check(request, timeout=120).status
            return bool(status == health_pb2.HealthCheckResponse.SERVING)

        wait_until(is_serving)
    reflection = reflection_pb2_grpc.ServerReflectionStub(channel)
    request = reflection_pb2.ServerReflectionRequest(list_services="*")
    (answer,) = reflection.ServerReflectionInfo(iter([request]), timeout=120)
    names = {service.name for service in answer.list_services_response.service}
    assert {"ultragray.v1.RenderService", "ultragray.v1.SceneService", "grpc.health.v1.Health"} <= names


def test_request_id_is_echoed(scenes: Stub) -> None:
    call = scenes.GetScene.with_call(scenes_pb2.GetSceneRequest(scene="demo"), metadata=(("x-request-id", "robot-1"),))[
        1
    ]
    assert dict(call.trailing_metadata())["x-request-id"] == "robot-1"


@pytest.mark.parametrize(
    ("kind", "method"),
    [
        ("unary_unary", "SceneService/GetScene"),
        ("unary_stream", "RenderService/RenderBatch"),
        ("stream_unary", "DatasetService/UploadDataset"),
    ],
)
def test_bytes_that_are_no_message_are_refused_in_our_words(
    service: RunningService, channel: grpc.Channel, kind: str, method: str
) -> None:
    garbage = b"\x0a\x05ab"  # a text of five bytes, of which two are there
    call = getattr(channel, kind)(f"/ultragray.v1.{method}")
    with pytest.raises(grpc.RpcError) as caught:
        list(call(iter([garbage]) if kind.startswith("stream") else garbage, timeout=120))
    assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert error_info(caught.value)[0].reason == "INVALID_ARGUMENT"
    assert "DecodeError" not in str(caught.value.details())
    assert "DecodeError" not in service.log_path.read_text()
