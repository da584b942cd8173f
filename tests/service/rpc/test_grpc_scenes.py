"""SceneService, health and reflection, and what holds for every call: its errors, its size, a caller who is gone."""

import asyncio
import logging

import grpc
import httpx
import pytest
from google.protobuf.empty_pb2 import Empty
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from ultragray_proto.v1 import rendering_pb2, rendering_pb2_grpc, scenes_pb2
from ultragray_service.rpc.calls import CallContext, abort
from ultragray_service.settings import load_settings
from ultragray_service.wiring import make_service
from ultragray_workers.errors import DeadlineExceeded

from .test_grpc_render import error_info


def test_reflection(channel):
    reflection = reflection_pb2_grpc.ServerReflectionStub(channel)
    request = reflection_pb2.ServerReflectionRequest(list_services="*")
    (answer,) = reflection.ServerReflectionInfo(iter([request]), timeout=300)
    names = {service.name for service in answer.list_services_response.service}
    assert {"ultragray.v1.RenderService", "ultragray.v1.SceneService", "grpc.health.v1.Health"} <= names


def test_request_id_is_echoed(scenes):
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
def test_bytes_that_are_no_message_are_refused_in_our_words(service, channel, kind, method):
    garbage = b"\x0a\x05ab"  # a text of five bytes, of which two are there
    call = getattr(channel, kind)(f"/ultragray.v1.{method}")
    with pytest.raises(grpc.RpcError) as caught:
        list(call(iter([garbage]) if kind.startswith("stream") else garbage, timeout=300))
    assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert error_info(caught.value)[0].reason == "INVALID_ARGUMENT"
    assert "DecodeError" not in str(caught.value.details())
    assert "DecodeError" not in service.log_path.read_text()


def test_one_setting_bounds_bodies_and_messages(start_service, settings_message, pose_message):
    limit_bytes = 4 * 2**20
    service = start_service(max_body_bytes=limit_bytes)
    settings_message.height = settings_message.width = 8
    request = rendering_pb2.RenderBatchRequest(settings=settings_message, poses=[pose_message])
    with service.channel() as channel:
        render = rendering_pb2_grpc.RenderServiceStub(channel).RenderBatch
        request.MergeFromString(b"\xfa\x7f\x80\x80\xc0\x01" + bytes(3 * 2**20))  # a field that nobody knows, of 3 MiB
        assert len(list(render(request, timeout=300))) == 1
        request.MergeFromString(b"\xfa\x7f\x80\x80\x80\x01" + bytes(2 * 2**20))
        with pytest.raises(grpc.RpcError) as refused:
            list(render(request, timeout=300))
    assert refused.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    answer = httpx.post(f"{service.http}/v1/scenes/demo/render", content=b" " * (limit_bytes + 1), timeout=300)
    assert answer.json()["detail"] == f"the body must be at most {limit_bytes} bytes"


METHOD = "/ultragray.v1.JobService/WatchJob"


class Streaming(grpc.GenericRpcHandler):
    """A call that writes once more when its caller is gone, as if that was not known yet."""

    def __init__(self):
        self.ended = asyncio.Event()

    def service(self, details):
        return grpc.unary_stream_rpc_method_handler(self._stream, Empty.FromString, Empty.SerializeToString)

    async def _stream(self, request, context):
        await context.write(Empty())
        try:
            await asyncio.sleep(60)
        except asyncio.CancelledError:
            self.ended.set()
            await context.write(Empty())


async def vanish(folder):
    server = grpc.aio.server(interceptors=[CallContext(make_service(load_settings(data_folder=folder)))])
    streaming = Streaming()
    server.add_generic_rpc_handlers([streaming])
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
        call = channel.unary_stream(METHOD, Empty.SerializeToString, Empty.FromString)(Empty())
        await call.read()
        call.cancel()
    await asyncio.wait_for(streaming.ended.wait(), 60)  # the connection is closed, too
    await server.stop(5)


def test_a_write_to_a_caller_that_is_gone_is_a_cancelled_call(tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        asyncio.run(vanish(tmp_path))
    (record,) = caplog.records
    fields = vars(record)["fields"]
    assert (record.getMessage(), fields["method"], fields["status"]) == ("request", METHOD, "CANCELLED")


class WritingTwice(Streaming):
    """A call that begins a message before the one before it is written, which grpc refuses."""

    async def _stream(self, request, context):
        await asyncio.gather(*(context.write(Empty()) for _ in range(2)))


async def answers_of(handler, folder):
    server = grpc.aio.server(interceptors=[CallContext(make_service(load_settings(data_folder=folder)))])
    server.add_generic_rpc_handlers([handler])
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
        call = channel.unary_stream(METHOD, Empty.SerializeToString, Empty.FromString)(Empty(), timeout=60)
        try:
            return [answer async for answer in call]
        finally:
            await server.stop(5)


def test_a_caller_that_is_there_is_told_of_a_write_that_failed(tmp_path):
    with pytest.raises(grpc.aio.AioRpcError) as failure:
        asyncio.run(answers_of(WritingTwice(), tmp_path))
    assert (failure.value.code(), failure.value.details()) == (
        grpc.StatusCode.INTERNAL,
        "an answer could not be sent",
    )


class Gone:
    """A context as grpc leaves it for a moment when the caller's deadline passes: it cannot be provoked at will."""

    async def abort(self, *_):
        raise grpc.aio.InternalError('Failed "execute_batch"')


def test_an_error_for_a_caller_that_is_gone_is_a_cancelled_call():
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(abort(Gone(), DeadlineExceeded("the deadline passed")))
