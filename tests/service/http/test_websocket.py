"""The WebSocket streams of a real service, and those who watch the streams of others."""

import contextlib
import json
import socket
import struct
import time
from dataclasses import fields

import numpy as np
import pytest
from pydantic import TypeAdapter
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from ultragray_client import Client
from ultragray_proto.v1 import geometry_pb2, rendering_pb2, rendering_pb2_grpc
from ultragray_service.core.streams import MAX_MESSAGE_BYTES, MAX_POSE_BYTES
from ultragray_service.http.routes.streams import FrameMessage, RefusalMessage

from ...waiting import wait_until
from ..conftest import HEIGHT, WIDTH, split

TIMEOUT_S = 300.0
KEY = "a-key-of-twenty-chars"


def at(x):
    return {"position_mm": {"x": x, "y": 0.0, "z": 0.0}, "quaternion": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}}


def checked(kind, text):
    """The JSON of a message, which must be as the OpenAPI document says."""
    TypeAdapter(kind).validate_json(text)
    document = json.loads(text)
    assert document.keys() == {field.name for field in fields(kind)}
    return document


class Stream:
    """A client's end of a stream."""

    def __init__(self, connection):
        self.connection = connection

    def send(self, **message):
        self.connection.send(json.dumps(message))

    def receive(self):
        message = self.connection.recv(timeout=TIMEOUT_S)
        if isinstance(message, str):
            return checked(RefusalMessage, message), b""
        (length,) = struct.unpack_from("<I", message)
        assert (4 + length) % 8 == 0
        return checked(FrameMessage, message[4 : 4 + length]), message[4 + length :]

    def ask(self, **message):
        self.send(**message)
        return self.receive()


@pytest.fixture
def open_stream(service):
    with contextlib.ExitStack() as opened:

        def open_(scene="demo", **options):
            connection = connect(
                service.stream_url(scene), compression=None, max_size=None, close_timeout=0.2, **options
            )
            return Stream(opened.enter_context(connection))

        yield open_


def test_an_answer_has_what_its_message_gave(open_stream):
    about, data = open_stream().ask(
        sequence=2**40, settings={"encoding": "float32"}, pose=at(1.5), client_time_ms=12.25
    )
    assert (about["sequence"], about["client_time_ms"], about["dropped"]) == (2**40, 12.25, 0)
    assert (about["scene"], about["height"], about["width"]) == ("demo", HEIGHT, WIDTH)
    assert about["pose"][0] == [1.0, 0.0, 0.0, 1.5]
    assert about["render_ms"] > 0
    assert len(data) == 4 * HEIGHT * WIDTH


def test_a_frame_is_that_of_where_the_probe_will_be(open_stream):
    stream = open_stream()
    for k in range(60):  # 30 mm/s
        stream.send(sequence=k, pose=at(0.3 * k), client_time_ms=10.0 * k, predict_ms=50.0)
    answers = [stream.receive()[0] for _ in range(60)]
    assert answers[-1]["pose"][0][3] == pytest.approx(0.3 * 59 + 1.5, abs=0.1)
    assert answers[-1]["prediction"]["ahead_ms"] == 50.0
    assert answers[-1]["prediction"]["error_mm"] < 1.5
    about, _ = stream.ask(sequence=60, pose=at(7.0), client_time_ms=600.0)
    assert (about["pose"][0][3], about["prediction"]) == (7.0, None)
    for message, field in (
        ({"client_time_ms": 1.0, "predict_ms": 1001}, "predict_ms"),
        ({"predict_ms": 5}, "client_time_ms"),
    ):
        stream.send(sequence=61, pose=at(0.0), **message)
        assert stream.receive()[0]["error"]["field"] == field


def test_clocks_are_aligned_by_the_messages_that_come_anyway(open_stream):
    stream, ahead_ms = open_stream(), 37_000.0

    def client_ms():  # of a clock that is ahead of the service's, which has that of this host
        return 1e3 * time.time() + ahead_ms

    about, _ = stream.ask(pose=at(0.0), client_time_ms=client_ms())
    assert (about["clock"], about["age_ms"]) == (None, None)
    for _ in range(10):
        arrived_ms = client_ms()
        stamps = {"answer_sent_ms": about["sent_ms"], "answer_arrived_ms": arrived_ms, "sent_ms": client_ms()}
        about, _ = stream.ask(pose=at(0.0), client_time_ms=client_ms() - 250.0, clock=stamps)
    assert about["age_ms"] + about["clock"]["uncertainty_ms"] >= 250.0
    stream.send(pose={"matrix": [[1.0]]})
    for clock in (about["clock"], stream.receive()[0]["clock"]):
        assert abs(clock["offset_ms"] - ahead_ms) <= clock["uncertainty_ms"] + 50.0


def test_late_real_frames_correct_what_the_scene_shows_at_present(open_stream):
    """The real probe's frames have half the scene's contrast and a mark, which goes along with it."""
    stream, frames, previews = open_stream(), [], []

    def real(k):
        image = frames[k].copy() // 2 + 40
        image[4:10, 4:10] = 250
        return image

    for k in range(60):
        about, data = stream.ask(sequence=k, pose=at(0.0), client_time_ms=50.0 * k)
        frames.append(np.frombuffer(data, np.uint8).reshape(HEIGHT, WIDTH) if about["preview"] is None else frames[-1])
        if about["preview"] is not None:
            previews.append(about["preview"])
            break
        header = {"client_time_ms": 0.0, "image_height": HEIGHT, "image_width": WIDTH}
        message = json.dumps({"real": header}).encode()
        stream.connection.send(len(message).to_bytes(4, "little") + message + real(0).tobytes())
    shown = np.frombuffer(data, np.uint8).reshape(HEIGHT, WIDTH)
    assert np.abs(shown.astype(int) - real(0)).max() <= 3
    assert previews[0]["agreement"] > 0.5
    assert not previews[0]["disagrees"]
    assert previews[0]["moved_mm"] == 0.0
    assert previews[0]["real_age_ms"] == 50.0 * about["sequence"]


@pytest.mark.parametrize(
    ("real", "image", "settings", "why"),
    [
        ({"client_time_ms": 1e6}, b"", {}, "between those of poses"),
        ({"client_time_ms": 5.0}, b"no picture", {}, "PNG"),
        ({"client_time_ms": 5.0, "image_height": 2, "image_width": 2}, b"123", {}, "4 bytes of grey pixels, got 3"),
        ({"client_time_ms": 5.0, "image_height": 2}, b"123", {}, "go together"),
        ({"client_time_ms": 5.0}, b"", {"outputs": ["echo"]}, "bmode alone"),
    ],
)
def test_a_real_frame_that_cannot_be_compared_is_refused(open_stream, real, image, settings, why):
    stream = open_stream()
    for k in range(2):
        stream.ask(pose=at(0.0), client_time_ms=10.0 * k, settings=settings)
    message = json.dumps({"sequence": 7, "real": real}).encode()
    stream.connection.send(len(message).to_bytes(4, "little") + message + image)
    about, _ = stream.receive()
    assert about["sequence"] == 7
    assert why in about["error"]["detail"]
    assert stream.ask(pose=at(0.0))[1]


def test_another_registration_or_scene_begins_another_path(open_stream):
    stream = open_stream()
    for k in range(30):
        stream.ask(
            sequence=k,
            pose=at(0.3 * k),
            client_time_ms=10.0 * k,
            predict_ms=50.0,
            settings={"height": 8 + k, "width": 8},
        )
    about, _ = stream.ask(sequence=31, pose=at(9.0), client_time_ms=300.0, predict_ms=50.0)
    assert about["pose"][0][3] > 9.5, "another image size does not"


def test_ordered_streams_answer_every_pose_and_settings_may_change(open_stream):
    stream = open_stream()
    for k in range(30):
        settings = {"settings": {"height": 10, "width": 12}} if k == 20 else {}
        stream.send(sequence=k, pose=at(k / 10), **settings)
    answers = [stream.receive()[0] for _ in range(30)]
    assert [answer["sequence"] for answer in answers] == list(range(30))
    assert [answer["height"] for answer in answers] == [HEIGHT] * 20 + [10] * 10


def test_bad_messages_do_not_end_a_stream(open_stream):
    stream = open_stream()

    def refused(**message):
        about, _ = stream.ask(sequence=5, **message)
        assert about["sequence"] == 5
        assert about["error"]["detail"]
        return about["error"]["reason"], about["error"]["field"]

    unanswerable = {"sequence": 7, "client_time_ms": 1.5, "pose": {"matrix": [[1.0]]}}
    about, _ = stream.ask(**unanswerable)
    assert (about["sequence"], about["client_time_ms"]) == (7, 1.5)
    assert refused(pose={"matrix": np.diag([-1.0, 1, 1, 1]).tolist()}) == ("INVALID_POSE", "pose.matrix")
    assert refused(settings={"outputs": ["colour"]}) == ("UNKNOWN_OUTPUT", "settings.outputs")
    assert refused(mode="newest") == ("INVALID_ARGUMENT", "mode")
    stream.connection.send("{")
    assert stream.receive()[0]["error"]["reason"] == "INVALID_ARGUMENT"
    stream.connection.send(b"\x00\x01")
    assert stream.receive()[0]["error"]["reason"] == "INVALID_ARGUMENT"
    assert refused(pose=at(0.0), timeout_ms=1e-6)[0] == "DEADLINE_EXCEEDED"
    assert stream.ask(pose=at(0.0))[1]


def test_refused_settings_change_nothing(open_stream):
    stream = open_stream()
    bad = {"height": 100_000}
    assert stream.ask(sequence=1, settings=bad)[0]["error"]["field"] == "settings.height"
    assert stream.ask(sequence=2, pose=at(0.0))[0]["error"]["field"] == "settings"
    assert stream.ask(sequence=3, settings={"height": 10, "width": 12}, pose=at(0.0))[0]["height"] == 10
    assert stream.ask(sequence=4, settings=bad, pose=at(0.0))[0]["error"]["field"] == "settings.height"
    assert stream.ask(sequence=5, pose=at(0.0))[0]["height"] == 10


def test_clients_that_break_off_leave_no_trace(service, open_stream):
    before = len(service.log())
    for _ in range(6):
        stream = open_stream()
        for k in range(20):
            stream.send(settings={"height": 600, "width": 600}, pose=at(k / 10))
        stream.receive()
        assert service.metric("ultragray_open_streams") >= 1
        stream.connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        stream.connection.socket.close()
    assert open_stream().ask(pose=at(0.0))[1]
    wait_until(lambda: service.metric("ultragray_open_streams") <= 1)
    assert [record for record in service.log()[before:] if record["level"] == "error"] == []


def test_what_cannot_be_streamed_is_refused_before_it_begins(service):
    with pytest.raises(InvalidStatus) as refusal, connect(service.stream_url("nowhere")):
        pass
    assert refusal.value.response.status_code == 404
    problem = json.loads(refusal.value.response.body)
    assert problem["reason"] == "SCENE_NOT_FOUND"


@pytest.mark.parametrize("origin", ["http://elsewhere.example", ""])
def test_pages_of_other_sites_are_refused(service, origin):
    before = len(service.log())
    with pytest.raises(InvalidStatus) as refusal, connect(service.stream_url(), origin=origin):
        pass
    assert [record for record in service.log()[before:] if record["level"] == "error"] == []
    assert json.loads(refusal.value.response.body)["reason"] == "ORIGIN_REFUSED"


def test_a_message_beyond_the_limit_ends_the_stream_only(open_stream):
    stream, other = open_stream(), open_stream()
    about, _ = stream.ask(name="x" * MAX_POSE_BYTES)
    assert f"at most {MAX_POSE_BYTES} bytes" in about["error"]["detail"]
    stream.connection.send("x" * (8 * MAX_MESSAGE_BYTES))  # more than a connection's buffers hold
    with pytest.raises(ConnectionClosed, match="1009"):
        stream.receive()
    assert other.ask(pose=at(0.0))[1]


def test_a_stop_ends_streams_after_their_frames(start_service):
    service = start_service()
    with connect(service.stream_url(), max_size=None) as connection:
        stream = Stream(connection)
        stream.ask(pose=at(0.0))
        service.process.terminate()
        with pytest.raises(ConnectionClosed, match="1012"):
            stream.receive()
    assert service.terminate() == 0


POSES = 40


def streams(http, **query):
    return http.get("/v1/streams", params=query).raise_for_status().json()["streams"]


def watching(service, stream_id, **options):
    base = service.http.replace("http", "ws", 1)
    return connect(f"{base}/v1/streams/{stream_id}/watch", max_size=None, close_timeout=0.2, **options)


def shown(watcher):
    message = watcher.recv(timeout=TIMEOUT_S)
    return (json.loads(message), b"") if isinstance(message, str) else split(message)


@pytest.fixture
def robot(service):
    with connect(f"{service.stream_url()}?name=UR5", compression=None, max_size=None, close_timeout=0.2) as connection:
        yield connection


def named(http, name):
    """The newest stream of a name: that of the test before may still be closing."""
    return wait_until(lambda: next((one for one in reversed(streams(http)) if one["name"] == name), None))


def step(robot, sequence, x, **others):
    robot.send(json.dumps({"sequence": sequence, "mode": "latest", "pose": at(x), **others}))
    return shown(robot)


def test_a_real_frame_may_come_from_another_program(service, http, robot):
    """By its age: the messages of the stream align the clock of the robot, which is 37 s ahead."""

    def ask(sequence, **others):
        return step(robot, sequence, 0.0, client_time_ms=1e3 * time.time() + 37_000.0, **others)

    about, data = ask(0, settings={"height": HEIGHT, "width": WIDTH})
    path = f"/v1/streams/{named(http, 'UR5')['id']}/real-frames"
    size = {"image_height": HEIGHT, "image_width": WIDTH}
    refused = http.post(path, params={"age_ms": 1, **size}, content=data)
    assert (refused.status_code, refused.json()["field"]) == (422, "age_ms")
    for sequence in range(1, 1000):
        asked_s = time.time()
        now_ms = 1e3 * asked_s + 37_000.0
        stamps = {"answer_sent_ms": about["sent_ms"], "answer_arrived_ms": now_ms, "sent_ms": now_ms}
        about, _ = ask(sequence, clock=stamps)
        if about["preview"] is not None:
            break
        if sequence == 1:
            taken_s = time.time()
        elif asked_s - taken_s > 0.05:  # when the clocks agree better than the newest pose and this frame are apart
            age_ms = 1e3 * (time.time() - taken_s)
            sent = http.post(path, params={"age_ms": age_ms, **size}, content=data)
            assert sent.is_success, sent.text
    assert 0.0 < about["preview"]["real_age_ms"] < 60_000.0
    assert http.post("/v1/streams/none/real-frames", content=b"").status_code == 404
    both = http.post(path, params={"age_ms": 1, "client_time_ms": 2}, content=b"")
    assert both.json()["detail"] == "exactly one of client_time_ms and age_ms must be given"


def test_a_watcher_sees_each_frame_as_the_client_gets_it(service, http, robot):
    step(robot, 0, 0.0, settings={"height": 40, "width": 30, "outputs": ["bmode", "coverage"]})
    told = named(http, "UR5")
    assert (told["door"], told["scene"], told["frames"]) == ("websocket", "demo", 1)
    with watching(service, told["id"]) as watcher:
        wait_until(lambda: named(http, "UR5")["watchers"] == 1)
        for sequence in range(1, POSES + 1):
            own, pixels = step(robot, sequence, sequence / 10)
            seen, passed_on = shown(watcher)
            assert {**seen, "sent_ms": own["sent_ms"]} == own
            assert passed_on == pixels
    assert streams(http, scene="demo")
    assert streams(http, scene="another") == []


def test_a_watcher_is_told_of_refusals_and_of_the_end(service, http, robot):
    step(robot, 0, 0.0)
    told = named(http, "UR5")
    with watching(service, told["id"]) as watcher:
        wait_until(lambda: named(http, "UR5")["watchers"] == 1)
        robot.send(json.dumps({"sequence": 7, "pose": {"matrix": [[1]]}}))
        assert shown(robot)[0]["error"]["reason"] == "INVALID_POSE"
        about, _ = shown(watcher)
        assert (about["sequence"], about["error"]["reason"]) == (7, "INVALID_POSE")
        robot.close()
        with pytest.raises(ConnectionClosed) as closed:
            shown(watcher)
        assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1000, "STREAM_ENDED")
    with pytest.raises(InvalidStatus) as refused:
        watching(service, told["id"])
    assert json.loads(refused.value.response.body)["reason"] == "STREAM_NOT_FOUND"


def test_a_call_of_grpc_is_watched_too(service, http):
    with service.channel() as channel:
        calls = rendering_pb2_grpc.RenderServiceStub(channel)
        identity = geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=np.eye(4).ravel()))
        settings = rendering_pb2.RenderSettings(scene="demo", height=20, width=30)

        def requests():
            yield rendering_pb2.RenderStreamRequest(sequence=1, settings=settings, pose=identity)
            wait_until(lambda: named(http, "arm")["frames"] == 1)
            with watching(service, named(http, "arm")["id"]) as watcher:
                wait_until(lambda: named(http, "arm")["watchers"] == 1)
                yield rendering_pb2.RenderStreamRequest(sequence=2, pose=identity)
                seen.append(shown(watcher))

        seen = []
        metadata = (("x-ultragray-stream-name", "arm"),)
        frames = list(calls.RenderStream(requests(), metadata=metadata, timeout=TIMEOUT_S))
    assert [frame.sequence for frame in frames] == [1, 2]
    assert seen[0][0]["sequence"] == 2
    assert seen[0][1] == frames[1].data


def test_the_service_tells_its_ports(service, http):
    told = http.get("/v1/service").raise_for_status().json()
    assert told["grpc_port"] == int(service.grpc.rpartition(":")[2])
    assert (told["igtl_port"], told["tls"], told["key_required"]) == (None, False, False)


def test_poses_are_assessed_as_frames_are_without_their_support(service, http):
    poses = [at(0.0), at(2.5), {"matrix": np.eye(4).tolist()}]
    found = http.post("/v1/scenes/demo:assess", json={"poses": poses}).raise_for_status().json()["extrapolations"]
    with Client(service.grpc) as client:
        matrices = np.tile(np.eye(4), (3, 1, 1))
        matrices[1, 0, 3] = 2.5
        told = client.assess_poses("demo", matrices)
        frame = client.render("demo", matrices[1])
    assert [one["distance_mm"] for one in found] == [one.distance_mm for one in told]
    assert found[1]["distance_mm"] == pytest.approx(frame.extrapolation.distance_mm)
    assert found[1]["supported_share"] is told[1].supported_share is None
