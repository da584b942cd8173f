"""A reader of a latest stream gets no old frame, whatever it does: over gRPC one that acknowledges, else any."""

import json
import queue

import grpc
import numpy as np
import pytest
from websockets.sync.client import connect

from ultragray_proto.v1 import geometry_pb2, rendering_pb2

from ..freshness import WAITS, check_fresh
from ..waiting import wait_until
from .conftest import split

IDENTITY = geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=np.eye(4).ravel().tolist()))
SMALL = {"height": 128, "width": 128, "encoding": "jpeg"}  # some KB: buffers hold hundreds of them
LARGE = {"height": 512, "width": 512, "encoding": "float32"}  # 1 MB
LATEST = rendering_pb2.STREAM_MODE_LATEST


class GrpcDoor:
    """A client that acknowledges each frame as it takes it."""

    def __init__(self, renders, settings, window=1):
        self._messages = queue.Queue()
        self.frames = renders.RenderStream(iter(self._messages.get, None))
        asked = {**settings, "encoding": f"ENCODING_{settings['encoding'].upper()}"}
        self.put(settings=rendering_pb2.RenderSettings(scene="demo", **asked), mode=LATEST, window=window)

    def put(self, **fields):
        self._messages.put(rendering_pb2.RenderStreamRequest(**fields))

    def send(self, number):
        self.put(sequence=number, pose=IDENTITY)

    def take(self):
        frame = next(self.frames)
        assert not frame.HasField("error"), frame.error
        return frame

    def receive(self):
        frame = self.take()
        self.put(acknowledged=frame.sequence)
        return frame.sequence

    def close(self):
        self._messages.put(None)
        self.frames.cancel()


class WebSocketDoor:
    """A client that reads a WebSocket."""

    def __init__(self, service, connection, settings):
        self._connection, port = connection, connection.local_address[1]
        self._poses = lambda: service.poses_from(port)
        connection.send(json.dumps({"mode": "latest", "settings": settings}))

    def send(self, number):
        self._connection.send(json.dumps({"pose": {"matrix": np.eye(4).tolist()}, "sequence": number}))
        wait_until(lambda: self._poses() == number)

    def receive(self):
        about, _ = split(self._connection.recv(timeout=300))
        return about["sequence"]


@pytest.fixture(scope="module")
def patient(start_service):
    return start_service(waits=WAITS)


@pytest.fixture
def open_grpc(renders):
    doors = []

    def open_one(settings, window=1):
        doors.append(GrpcDoor(renders, settings, window))
        return doors[-1]

    yield open_one
    for door in doors:
        door.close()


@pytest.mark.parametrize("settings", [SMALL, pytest.param(LARGE, marks=pytest.mark.long)], ids=["small", "large"])
def test_grpc(open_grpc, settings):
    check_fresh(open_grpc(settings))


@pytest.mark.parametrize("settings", [SMALL, pytest.param(LARGE, marks=pytest.mark.long)], ids=["small", "large"])
def test_websocket_without_acknowledgements(patient, settings):
    with connect(patient.stream_url(), compression=None, max_size=None, close_timeout=0.2) as connection:
        check_fresh(WebSocketDoor(patient, connection, settings), excused=1)


def test_no_more_answers_come_than_the_window_has_room_for(open_grpc, service):
    door = open_grpc(SMALL, window=3)
    for number in range(1, 4):
        door.send(number)
        door.take()
    service.wait_until_idle()
    frames = service.metric("ultragray_frames_total")
    for number in range(4, 24):
        door.send(number)
    door.put()  # neither pose nor settings: its refusal comes after all that was to come
    refusal = next(door.frames)
    assert (refusal.error.field, refusal.dropped) == ("pose", 19)
    assert service.metric("ultragray_frames_total") == frames
    door.put(acknowledged=12345)  # of no answer
    door.put(acknowledged=2)
    assert door.take().sequence == 23


@pytest.mark.parametrize("window", [None, 17])
def test_a_latest_call_needs_a_window_within_the_limit(open_grpc, window):
    with pytest.raises(grpc.RpcError, match="needs a window of 1 to 16 answers") as refused:
        open_grpc(SMALL, window).take()
    assert refused.value.code() is grpc.StatusCode.INVALID_ARGUMENT
