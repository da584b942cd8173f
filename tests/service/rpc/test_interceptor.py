"""Calls whose caller is gone."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path
from typing import Any

import grpc
import pytest
from google.protobuf.empty_pb2 import Empty

from ultragray_service.rpc.calls import CallContext, abort
from ultragray_service.settings import load_settings
from ultragray_service.wiring import make_service
from ultragray_workers.errors import DeadlineExceeded

METHOD = "/ultragray.v1.JobService/WatchJob"


class Streaming(grpc.GenericRpcHandler):  # type: ignore[misc]
    """A call that writes once more when its caller is gone, as if that was not known yet."""

    def __init__(self) -> None:
        self.ended = asyncio.Event()

    def service(self, details: Any) -> Any:
        return grpc.unary_stream_rpc_method_handler(self._stream, Empty.FromString, Empty.SerializeToString)

    async def _stream(self, request: Any, context: Any) -> None:
        await context.write(Empty())
        try:
            await asyncio.sleep(60)
        except asyncio.CancelledError:
            self.ended.set()
            await context.write(Empty())


async def vanish(folder: Path) -> None:
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


def test_a_write_to_a_caller_that_is_gone_is_a_cancelled_call(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        asyncio.run(vanish(tmp_path))
    (record,) = caplog.records
    fields = vars(record)["fields"]
    assert (record.getMessage(), fields["method"], fields["status"]) == ("request", METHOD, "CANCELLED")


class Gone:
    """A context as grpc leaves it for a moment when the caller's deadline passes: it cannot be provoked at will."""

    async def abort(self, *_: Any) -> None:
        raise grpc.aio.InternalError('Failed "execute_batch"')


def test_an_error_for_a_caller_that_is_gone_is_a_cancelled_call() -> None:
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(abort(Gone(), DeadlineExceeded("the deadline passed")))
