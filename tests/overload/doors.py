"""The doors, as clients that overload them see them."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import time
from collections.abc import Awaitable, Callable
from typing import Any

import grpc
import numpy as np
from websockets.asyncio.client import ClientConnection, connect

from ultragray_proto.v1 import geometry_pb2, rendering_pb2, rendering_pb2_grpc
from ultragray_service.igtl.contents import pack_transform, unpack_status
from ultragray_service.igtl.messages import HEADER_BYTES, Message, pack_message, unpack_header, unpack_message

from ..service.conftest import RunningService
from ..service.igtl.conftest import address_of
from .load import Refused, Seen, ask_at

SCENE = "heavy"
POSE = {"matrix": np.eye(4).tolist()}
MESSAGE = geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=np.eye(4).ravel().tolist()))
SETTINGS = rendering_pb2.RenderSettings(scene=SCENE)
GRPC_CONNECTIONS = 8
DEADLINE_S = 2.0  # of calls that wait for others of the same connection, which no limit of the service is about
_NS = 1e9


class Place:
    """Where a client is: an address of this machine, and its connections of gRPC, which cannot choose theirs."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._channels: list[grpc.aio.Channel] = []
        self._next = itertools.cycle(range(GRPC_CONNECTIONS))

    def channel(self, service: RunningService) -> grpc.aio.Channel:
        """One of a few connections, in turn."""
        if len(self._channels) < GRPC_CONNECTIONS:
            options = [("grpc.use_local_subchannel_pool", 1), ("grpc.max_receive_message_length", -1)]
            self._channels.append(grpc.aio.insecure_channel(service.grpc, options=options))
        return self._channels[next(self._next)]

    async def close(self) -> None:
        for channel in self._channels:
            await channel.close()


class Http:
    """A connection that is kept alive."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer
        body = json.dumps({"pose": POSE}).encode()
        self._request = (
            f"POST /v1/scenes/{SCENE}/render HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
            f"Accept: application/octet-stream\r\nContent-Length: {len(body)}\r\n\r\n"
        ).encode() + body

    @classmethod
    async def open(cls, service: RunningService, place: Place) -> Http:
        host, _, port = service.http.removeprefix("http://").rpartition(":")
        return cls(*await asyncio.open_connection(host, int(port), local_addr=(place.address, 0)))

    async def ask(self) -> None:
        self._writer.write(self._request)
        head = await self._reader.readuntil(b"\r\n\r\n")
        fields = dict(line.split(b": ", 1) for line in head.lower().split(b"\r\n")[1:] if line)
        body = await self._reader.readexactly(int(fields[b"content-length"]))
        if not head.startswith(b"HTTP/1.1 200"):
            raise Refused(json.loads(body)["reason"])

    async def pour(self, rate: float, until: float, seen: Seen) -> None:
        await ask_at(self, rate, until, seen)

    async def close(self) -> None:
        self._writer.close()
        with contextlib.suppress(ConnectionError):
            await self._writer.wait_closed()


class GrpcUnary:
    """Calls, several at a time over each connection."""

    def __init__(self, channel: grpc.aio.Channel) -> None:
        self._render = rendering_pb2_grpc.RenderServiceStub(channel).Render

    @classmethod
    async def open(cls, service: RunningService, place: Place) -> GrpcUnary:
        return cls(place.channel(service))

    async def ask(self) -> None:
        try:
            await self._render(rendering_pb2.RenderRequest(settings=SETTINGS, pose=MESSAGE), timeout=DEADLINE_S)
        except grpc.aio.AioRpcError as error:
            raise Refused(error.code().name) from None

    async def pour(self, rate: float, until: float, seen: Seen) -> None:
        await ask_at(self, rate, until, seen)

    async def close(self) -> None:
        """The connection is its client's."""


class _Stream:
    """A stream in which the time at which a pose was sent comes back with its frame."""

    async def ask(self) -> None:
        await self.send()
        await self.receive()

    async def pour(self, rate: float, until: float, seen: Seen) -> None:
        """Poses at a rate, while another task takes what comes back."""

        async def take() -> None:
            while True:
                try:
                    sent_ns = await self.receive()
                except Refused as refused:
                    seen.refusals[str(refused)] += 1
                else:
                    seen.take((time.monotonic_ns() - sent_ns) / _NS)

        taker = asyncio.ensure_future(take())
        due = time.monotonic()
        while time.monotonic() < until and not taker.done():
            await self.send()
            seen.asked += 1
            due += 1 / rate
            await asyncio.sleep(max(0.0, due - time.monotonic()))
        taker.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await taker

    async def send(self) -> None:
        raise NotImplementedError

    async def receive(self) -> int:
        """When the pose of the next frame was sent. Raises Refused."""
        raise NotImplementedError


class GrpcStream(_Stream):
    """A stream with the mode latest."""

    def __init__(self, channel: grpc.aio.Channel) -> None:
        self._call = rendering_pb2_grpc.RenderServiceStub(channel).RenderStream()
        self._first: dict[str, Any] = {"settings": SETTINGS, "mode": rendering_pb2.STREAM_MODE_LATEST}

    @classmethod
    async def open(cls, service: RunningService, place: Place) -> GrpcStream:
        return cls(place.channel(service))

    async def send(self) -> None:
        message = rendering_pb2.RenderStreamRequest(pose=MESSAGE, client_time_ns=time.monotonic_ns(), **self._first)
        self._first = {}
        await self._call.write(message)

    async def receive(self) -> int:
        frame = await self._call.read()
        if frame.error.reason:
            raise Refused(frame.error.reason)
        return int(frame.client_time_ns)

    async def close(self) -> None:
        self._call.cancel()


class WebSocketStream(_Stream):
    """The same over a WebSocket."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._first: dict[str, Any] = {"mode": "latest"}

    @classmethod
    async def open(cls, service: RunningService, place: Place) -> WebSocketStream:
        address = f"{service.http.replace('http', 'ws', 1)}/v1/scenes/{SCENE}/stream"
        return cls(await connect(address, compression=None, max_size=None, local_addr=(place.address, 0)))

    async def send(self) -> None:
        message = {"pose": POSE, "client_time_ms": time.monotonic_ns() / 1e6, **self._first}
        self._first = {}
        await self._connection.send(json.dumps(message))

    async def receive(self) -> int:
        answer = await self._connection.recv()
        if isinstance(answer, str):
            raise Refused(json.loads(answer)["error"]["reason"])
        header = json.loads(answer[4 : 4 + int.from_bytes(answer[:4], "little")])
        return int(header["client_time_ms"] * 1e6)

    async def close(self) -> None:
        await self._connection.close()


class Igtl(_Stream):
    """Poses as TRANSFORM, frames as IMAGE: of poses that wait only the newest is rendered."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    @classmethod
    async def open(cls, service: RunningService, place: Place) -> Igtl:
        host, _, port = address_of(service).rpartition(":")
        return cls(*await asyncio.open_connection(host, int(port), local_addr=(place.address, 0)))

    async def send(self) -> None:
        content = pack_transform(np.eye(4))
        self._writer.write(pack_message(Message("TRANSFORM", SCENE, content, timestamp=time.monotonic_ns())))
        await self._writer.drain()

    async def receive(self) -> int:
        header = unpack_header(await self._reader.readexactly(HEADER_BYTES))
        body = await self._reader.readexactly(header.body_bytes)
        if header.type_name == "STATUS":
            raise Refused(unpack_status(unpack_message(header, body).content).name)
        return header.timestamp

    async def close(self) -> None:
        self._writer.close()
        with contextlib.suppress(ConnectionError):
            await self._writer.wait_closed()


Open = Callable[[RunningService, Place], Awaitable[Any]]
DOORS: dict[str, Open] = {
    "http": Http.open,
    "grpc": GrpcUnary.open,
    "grpc stream": GrpcStream.open,
    "websocket": WebSocketStream.open,
    "igtl": Igtl.open,
}
