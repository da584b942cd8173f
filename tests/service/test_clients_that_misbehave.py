"""Slow, idle and vanishing clients of the streams: bounded memory, and nobody else loses a frame."""

import json
import threading
import time

import grpc
import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

from ultragray_proto.v1 import geometry_pb2, rendering_pb2, rendering_pb2_grpc

IDENTITY = geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=np.eye(4).ravel().tolist()))
LARGE = rendering_pb2.RenderSettings(
    scene="demo", height=600, width=600, encoding=rendering_pb2.ENCODING_FLOAT32, outputs=[1, 2]
)  # 2.9 MB a frame
CALM_BYTES = 64 * 2**20
TIMEOUT_S = 300.0


def rendered(service):
    return service.metric("ultragray_frames_total")


def until_calm(service):
    """Frames rendered in all, once that does not grow for half a second."""
    end = time.monotonic() + TIMEOUT_S
    count = rendered(service)
    while time.monotonic() < end:
        time.sleep(0.5)
        if (now := rendered(service)) == count:
            return count
        count = now
    raise AssertionError("frames are rendered without end")


@pytest.fixture
def renders(service):
    """Over a connection whose window stays as it is: gRPC lets that of a busy machine grow to 100 MB and more."""
    options = [("grpc.http2.bdp_probe", 0), ("grpc.max_receive_message_length", -1)]
    with grpc.insecure_channel(service.grpc, options=options) as channel:
        yield rendering_pb2_grpc.RenderServiceStub(channel)


def test_a_batch_whose_reader_stops_waits_for_him(service, renders):
    before, frames_before = service.resident_bytes(), rendered(service)
    call = renders.RenderBatch(rendering_pb2.RenderBatchRequest(settings=LARGE, poses=[IDENTITY] * 40))
    next(call)
    frames = until_calm(service) - frames_before
    assert frames < 40
    assert service.resident_bytes() - before < CALM_BYTES + 2 * 32 * 2.9e6
    small = rendering_pb2.RenderSettings(scene="demo", height=32, width=32)
    assert renders.Render(rendering_pb2.RenderRequest(settings=small, pose=IDENTITY), timeout=TIMEOUT_S).data
    assert len(list(call)) == 39


def test_a_stream_whose_reader_stops_waits_for_him(service, renders):
    def messages():
        yield rendering_pb2.RenderStreamRequest(settings=LARGE)
        for sequence in range(5000):
            yield rendering_pb2.RenderStreamRequest(sequence=sequence, pose=IDENTITY)

    before, frames_before = service.resident_bytes(), rendered(service)
    call = renders.RenderStream(messages())
    next(call)
    assert until_calm(service) - frames_before < 100
    assert service.resident_bytes() - before < CALM_BYTES
    call.cancel()


def test_many_mistakes_at_once_do_not_stop_a_stream(service):
    """More refusals wait than may be under way, while the client has yet to say that it has the first frame."""
    address = service.stream_url()
    pose = {"mode": "latest", "settings": {}, "pose": {"matrix": np.eye(4).tolist()}}
    with connect(address, compression=None, max_size=None, close_timeout=0.2) as connection:
        for sequence in range(3):
            connection.send(json.dumps({**pose, "sequence": sequence}))
            for _ in range(30):
                connection.send('{"settings": 3}')
        connection.send(json.dumps({**pose, "sequence": 99}))
        while isinstance(answer := connection.recv(TIMEOUT_S), str) or b'"sequence":99' not in answer:
            pass


def test_a_flood_of_messages_leaves_others_their_turn(service):
    """Settings and poses of a latest stream are never answered one by one: nothing slows the sender down."""
    address = service.stream_url()
    pose = json.dumps({"mode": "latest", "settings": {}, "pose": {"matrix": np.eye(4).tolist()}})
    over = threading.Event()

    def flood():
        while not over.is_set():
            connection.send(pose)

    with connect(address, compression=None, max_size=None, close_timeout=0.2) as connection, httpx.Client() as http:
        flooding = threading.Thread(target=flood)
        flooding.start()
        for _ in range(20):
            http.get(f"{service.http}/v1/health/live", timeout=TIMEOUT_S).raise_for_status()
        over.set()
        flooding.join()
