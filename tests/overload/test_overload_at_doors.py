"""Ten times as much as can be rendered, at each door: what can be rendered still is, soon, and for everybody."""

import asyncio
import contextlib
import itertools
import json
import os
import time
from collections import Counter
from dataclasses import dataclass, field, replace

import grpc
import numpy as np
import pytest
from websockets.asyncio.client import connect

from ultragray import GaussianScene
from ultragray_proto.v1 import geometry_pb2, rendering_pb2, rendering_pb2_grpc
from ultragray_service.igtl.contents import pack_transform, unpack_status
from ultragray_service.igtl.messages import HEADER_BYTES, Message, pack_message, unpack_header, unpack_message
from ultragray_studies.bench.report import measured

from ..service.conftest import DEMO_PROBE, make_scene, service_starter
from ..service.igtl.conftest import address_of
from ..surroundings import ROOT
from ..waiting import at_this_load


class Refused(Exception):
    """The service has refused a request, for this reason."""


@dataclass
class Seen:
    """What came back."""

    latencies_s: list[float] = field(default_factory=list)  # of the frames
    refusals: Counter[str] = field(default_factory=Counter)
    asked: int = 0

    def take(self, latency_s):
        self.latencies_s.append(latency_s)

    @property
    def frames(self):
        return len(self.latencies_s)

    @property
    def p99_s(self):
        return float(np.percentile(self.latencies_s, 99)) if self.latencies_s else 0.0


async def ask_at(connection, rate, until, seen):
    """Asks at a rate, but not before the last answer is there; 0: as fast as answers come."""
    due = time.monotonic()
    while (now := time.monotonic()) < until:
        if rate:
            await asyncio.sleep(due - now)
            due = max(due + 1 / rate, time.monotonic())
        began = time.monotonic()
        seen.asked += 1
        try:
            await connection.ask()
        except Refused as refused:
            seen.refusals[str(refused)] += 1
        else:
            seen.take(time.monotonic() - began)


SCENE = "heavy"
POSE = {"matrix": np.eye(4).tolist()}
MESSAGE = geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=np.eye(4).ravel().tolist()))
SETTINGS = rendering_pb2.RenderSettings(scene=SCENE)
GRPC_CONNECTIONS = 8
DEADLINE_S = 2.0  # of calls that wait for others of the same connection, which no limit of the service is about
_NS = 1e9


class Place:
    """Where a client is: an address of this machine, and its connections of gRPC, which cannot choose theirs."""

    def __init__(self, address):
        self.address = address
        self._channels = []
        self._next = itertools.cycle(range(GRPC_CONNECTIONS))

    def channel(self, service):
        """One of a few connections, in turn."""
        if len(self._channels) < GRPC_CONNECTIONS:
            options = [("grpc.use_local_subchannel_pool", 1), ("grpc.max_receive_message_length", -1)]
            self._channels.append(grpc.aio.insecure_channel(service.grpc, options=options))
        return self._channels[next(self._next)]

    async def close(self):
        for channel in self._channels:
            await channel.close()


class Http:
    """A connection that is kept alive."""

    def __init__(self, reader, writer):
        self._reader, self._writer = reader, writer
        body = json.dumps({"pose": POSE}).encode()
        self._request = (
            f"POST /v1/scenes/{SCENE}/render HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
            f"Accept: application/octet-stream\r\nContent-Length: {len(body)}\r\n\r\n"
        ).encode() + body

    @classmethod
    async def open(cls, service, place):
        host, _, port = service.http.removeprefix("http://").rpartition(":")
        return cls(*await asyncio.open_connection(host, int(port), local_addr=(place.address, 0)))

    async def ask(self):
        self._writer.write(self._request)
        head = await self._reader.readuntil(b"\r\n\r\n")
        fields = dict(line.split(b": ", 1) for line in head.lower().split(b"\r\n")[1:] if line)
        body = await self._reader.readexactly(int(fields[b"content-length"]))
        if not head.startswith(b"HTTP/1.1 200"):
            raise Refused(json.loads(body)["reason"])

    async def pour(self, rate, until, seen):
        await ask_at(self, rate, until, seen)

    async def close(self):
        self._writer.close()
        with contextlib.suppress(ConnectionError):
            await self._writer.wait_closed()


class GrpcUnary:
    """Calls, several at a time over each connection."""

    def __init__(self, channel):
        self._render = rendering_pb2_grpc.RenderServiceStub(channel).Render

    @classmethod
    async def open(cls, service, place):
        return cls(place.channel(service))

    async def ask(self):
        try:
            await self._render(rendering_pb2.RenderRequest(settings=SETTINGS, pose=MESSAGE), timeout=DEADLINE_S)
        except grpc.aio.AioRpcError as error:
            raise Refused(error.code().name) from None

    async def pour(self, rate, until, seen):
        await ask_at(self, rate, until, seen)

    async def close(self):
        """The connection is its client's."""


class _Stream:
    """A stream in which the time at which a pose was sent comes back with its frame."""

    async def ask(self):
        await self.send()
        await self.receive()

    async def pour(self, rate, until, seen):
        """Poses at a rate, while another task takes what comes back."""

        async def take():
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

    async def send(self):
        raise NotImplementedError

    async def receive(self):
        """When the pose of the next frame was sent. Raises Refused."""
        raise NotImplementedError


class GrpcStream(_Stream):
    """A stream with the mode latest."""

    def __init__(self, channel):
        self._call = rendering_pb2_grpc.RenderServiceStub(channel).RenderStream()
        self._writing = asyncio.Lock()  # gRPC takes one message at a time
        self._sequence = 0
        self._first = {"settings": SETTINGS, "mode": rendering_pb2.STREAM_MODE_LATEST, "window": 2}

    @classmethod
    async def open(cls, service, place):
        return cls(place.channel(service))

    async def send(self):
        self._sequence += 1
        about = {"sequence": self._sequence, "client_time_ns": time.monotonic_ns(), **self._first}
        self._first = {}
        await self._write(pose=MESSAGE, **about)

    async def receive(self):
        frame = await self._call.read()
        await self._write(acknowledged=frame.sequence)
        if frame.error.reason:
            raise Refused(frame.error.reason)
        return int(frame.client_time_ns)

    async def _write(self, **contents):
        async with self._writing:
            await self._call.write(rendering_pb2.RenderStreamRequest(**contents))

    async def close(self):
        self._call.cancel()


class WebSocketStream(_Stream):
    """The same over a WebSocket."""

    def __init__(self, connection):
        self._connection = connection
        self._first = {"mode": "latest"}

    @classmethod
    async def open(cls, service, place):
        address = f"{service.http.replace('http', 'ws', 1)}/v1/scenes/{SCENE}/stream"
        return cls(await connect(address, compression=None, max_size=None, local_addr=(place.address, 0)))

    async def send(self):
        message = {"pose": POSE, "client_time_ms": time.monotonic_ns() / 1e6, **self._first}
        self._first = {}
        await self._connection.send(json.dumps(message))

    async def receive(self):
        answer = await self._connection.recv()
        if isinstance(answer, str):
            raise Refused(json.loads(answer)["error"]["reason"])
        header = json.loads(answer[4 : 4 + int.from_bytes(answer[:4], "little")])
        return int(header["client_time_ms"] * 1e6)

    async def close(self):
        await self._connection.close()


class Igtl(_Stream):
    """Poses as TRANSFORM, frames as IMAGE: of poses that wait only the newest is rendered."""

    def __init__(self, reader, writer):
        self._reader, self._writer = reader, writer

    @classmethod
    async def open(cls, service, place):
        host, _, port = address_of(service).rpartition(":")
        return cls(*await asyncio.open_connection(host, int(port), local_addr=(place.address, 0)))

    async def send(self):
        content = pack_transform(np.eye(4))
        self._writer.write(pack_message(Message("TRANSFORM", SCENE, content, timestamp=time.monotonic_ns())))
        await self._writer.drain()

    async def receive(self):
        header = unpack_header(await self._reader.readexactly(HEADER_BYTES))
        body = await self._reader.readexactly(header.body_bytes)
        if header.type_name == "STATUS":
            raise Refused(unpack_status(unpack_message(header, body).content).name)
        return header.timestamp

    async def close(self):
        self._writer.close()
        with contextlib.suppress(ConnectionError):
            await self._writer.wait_closed()


DOORS = {
    "http": Http.open,
    "grpc": GrpcUnary.open,
    "grpc stream": GrpcStream.open,
    "websocket": WebSocketStream.open,
    "igtl": Igtl.open,
}


pytestmark = pytest.mark.long

SECONDS = float(os.environ.get("ULTRAGRAY_OVERLOAD_SECONDS", "6"))
RECORD = os.environ.get("ULTRAGRAY_OVERLOAD_RECORD")
IS_MEASURED = RECORD is not None  # on a machine that does nothing else
TIMES = 10
CAPACITY_CONNECTIONS, GREEDY_CONNECTIONS = 4, 120
GREEDY, POLITE = "127.0.0.1", "127.0.0.2"  # where the clients come from
POLITE_SHARE = 0.25  # of the capacity, which two clients share; of gRPC, whose clients have one address here, below
POLITE_SHARE_AMONG_CONNECTIONS = 0.8 / (GRPC_CONNECTIONS + 1)
LEAST_GOODPUT, LEAST_GOODPUT_AT_ANY_LOAD = 0.95, 0.4
LEAST_POLITE = 0.9  # of what the polite client asks for
MOST_P99_S, MOST_RECOVERY_S = 2.0, 2.0
GAUSSIANS = 1_000


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    """A service with one scene, of which a frame takes about 30 ms of one core."""
    folder = tmp_path_factory.mktemp("heavy")
    made = make_scene(GAUSSIANS, probe=DEMO_PROBE)
    heavy = replace(made.info, image_height=512, image_width=512)
    GaussianScene.from_splats(made.splats, info=heavy).save(folder / f"{SCENE}.ugr")
    starter = service_starter(tmp_path_factory, folder)
    start = next(starter)
    yield start(cold=True, data_folder=folder, igtl_port=0, igtl_scene=SCENE, max_footprint_pixels=2**62)
    starter.close()


@contextlib.asynccontextmanager
async def opened(door, service, count, address):
    """Connections of one client."""
    place = Place(address)
    connections = [await door(service, place) for _ in range(count)]
    yield connections
    await asyncio.gather(*(connection.close() for connection in connections))
    await place.close()


async def capacity_of(door, service, seconds):
    """Frames a second that a few connections get, each of which asks again as soon as it has got one."""
    async with opened(door, service, CAPACITY_CONNECTIONS, GREEDY) as connections:
        warm, seen = Seen(), Seen()
        await asyncio.gather(*(ask_at(one, 0, time.monotonic() + 1.0, warm) for one in connections))
        began = time.monotonic()
        await asyncio.gather(*(ask_at(one, 0, began + seconds, seen) for one in connections))
        assert seen.frames
        return seen.frames / (time.monotonic() - began)


async def overload(door, service, seconds, polite_share):
    """The capacity before and after, and what came back meanwhile."""
    before = await capacity_of(door, service, seconds / 4)
    got, wanted = Seen(), Seen()
    async with opened(door, service, GREEDY_CONNECTIONS, GREEDY) as greedy:
        async with opened(door, service, 1, POLITE) as (polite,):
            rate, until = TIMES * before / len(greedy), time.monotonic() + seconds
            await asyncio.gather(
                *(one.pour(rate, until, got) for one in greedy), ask_at(polite, polite_share * before, until, wanted)
            )
        ended = time.monotonic()
        async with opened(door, service, 1, POLITE) as (lone,):
            first = Seen()
            while not first.frames:
                await ask_at(lone, 0, time.monotonic() + 1e-3, first)
            recovery_s = time.monotonic() - ended
    after = await capacity_of(door, service, seconds / 4)
    capacity = (before + after) / 2
    return {
        "capacity_per_s": round(capacity, 2),
        "offered_per_s": round((got.asked + wanted.asked) / seconds, 1),
        "goodput": round((got.frames + wanted.frames) / seconds / capacity, 3),
        "p99_s": round(max(got.p99_s, wanted.p99_s), 3),
        "recovery_s": round(recovery_s, 3),
        "polite": round(wanted.frames / max(1, wanted.asked), 3),
        "polite_asked_per_s": round(wanted.asked / seconds, 2),
        "polite_p99_s": round(wanted.p99_s, 3),
        "refusals": dict(got.refusals + wanted.refusals),
    }


@pytest.mark.parametrize("door", DOORS)
def test_ten_times_the_capacity(service, door):
    polite_share = POLITE_SHARE_AMONG_CONNECTIONS if "grpc" in door else POLITE_SHARE
    found = asyncio.run(overload(DOORS[door], service, SECONDS, polite_share))
    if RECORD is not None:
        keep(ROOT / RECORD, door, found)
    assert found["goodput"] >= (LEAST_GOODPUT if IS_MEASURED else LEAST_GOODPUT_AT_ANY_LOAD), found
    assert found["p99_s"] <= at_this_load(MOST_P99_S), found
    assert found["recovery_s"] <= at_this_load(MOST_RECOVERY_S), found
    assert found["polite"] >= LEAST_POLITE, found
    before, traceback, after = service.log_path.read_text().partition("Traceback")
    assert not traceback, before[-1000:] + traceback + after[:4000]


def keep(path, door, figures):
    """Adds the figures of a door to the file of the run."""
    document = json.loads(path.read_text()) if path.exists() else {}
    document[door] = {"measured": measured(os.cpu_count() or 1), **figures}
    path.write_text(json.dumps(document, indent=1) + "\n")
