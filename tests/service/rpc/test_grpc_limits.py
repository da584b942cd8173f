"""The size of a message."""

from __future__ import annotations

import grpc
import httpx
import pytest

from ultragray_proto.v1 import geometry_pb2, rendering_pb2, rendering_pb2_grpc

from ..conftest import StartService


def test_one_setting_bounds_bodies_and_messages(
    start_service: StartService, settings_message: rendering_pb2.RenderSettings, pose_message: geometry_pb2.Pose
) -> None:
    limit_bytes = 4 * 2**20
    service = start_service(max_body_bytes=limit_bytes)
    settings_message.height = settings_message.width = 8
    request = rendering_pb2.RenderBatchRequest(settings=settings_message, poses=[pose_message])
    with service.channel() as channel:
        render = rendering_pb2_grpc.RenderServiceStub(channel).RenderBatch
        request.MergeFromString(b"\xfa\x7f\x80\x80\xc0\x01" + bytes(3 * 2**20))  # a field that nobody knows, of 3 MiB
        assert len(list(render(request, timeout=60))) == 1
        request.MergeFromString(b"\xfa\x7f\x80\x80\x80\x01" + bytes(2 * 2**20))
        with pytest.raises(grpc.RpcError) as refused:
            list(render(request, timeout=60))
    assert refused.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    answer = httpx.post(f"{service.http}/v1/scenes/demo/render", content=b" " * (limit_bytes + 1), timeout=60)
    assert answer.json()["detail"] == f"the body must be at most {limit_bytes} bytes"
