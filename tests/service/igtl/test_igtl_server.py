"""Through real sockets: pyigtl and a client of our own against a real service."""

import struct

import numpy as np
import pyigtl
import pytest

from ultragray.geometry.pose import check_poses
from ultragray_proto.v1 import rendering_pb2, rendering_pb2_grpc
from ultragray_service.igtl.contents import (
    Instrument,
    pack_instruments,
    pack_position,
    unpack_image,
    unpack_instruments,
    unpack_position,
    unpack_status,
    unpack_transform,
)

from ...freshness import WAITS, check_fresh
from ...waiting import wait_until
from ..conftest import DEMO_PROBE, HEIGHT, WIDTH
from ..rpc.test_grpc_render import matrix_pose
from .conftest import address_of, moved, pyigtl_client, random_pose

SLOW = {"backend": "reference", "max_batch_poses": 1}


def over_grpc(service, scene, pose):
    with service.channel() as channel:
        stub = rendering_pb2_grpc.RenderServiceStub(channel)
        settings = rendering_pb2.RenderSettings(scene=scene)
        frame = stub.Render(rendering_pb2.RenderRequest(settings=settings, pose=matrix_pose(pose)), timeout=300)
        return np.frombuffer(frame.data, np.uint8).reshape(frame.height, frame.width)


# Frames


@pytest.mark.parametrize("version", [1, 2])
def test_pyigtl_gets_the_frame_of_its_pose_in_its_place(igtl_service, version):
    pose = random_pose(1)
    theirs = pyigtl.TransformMessage(pose, device_name="ProbeToReference", timestamp=1234.5)
    theirs.header_version = version
    with pyigtl_client(address_of(igtl_service)) as client:
        client.send_message(theirs)
        answer = client.wait_for_message("Image_Reference", timeout=300)
    assert isinstance(answer, pyigtl.ImageMessage)
    assert (answer.timestamp, answer.header_version) == (1234.5, version)
    assert np.array_equal(answer.image[0], over_grpc(igtl_service, "demo", pose))
    assert answer.world_coordinate_system == "ras"
    edges = np.array([(i, j, 0, 1) for j in (-0.5, HEIGHT - 0.5) for i in (-0.5, WIDTH - 0.5)])
    corners = np.c_[DEMO_PROBE.corners_mm(), np.ones(4)] @ check_poses(pose)[0].T
    assert edges @ answer.ijk_to_world_matrix.T == pytest.approx(corners, abs=1e-4)
    assert answer.metadata.get("scene") == (None if version == 1 else "demo")


def test_every_type_of_pose_gets_the_same_frame(peer, igtl_service):
    pose = moved(3.0)
    expected = over_grpc(igtl_service, "demo", pose)
    peer.send_pose(pose)
    assert np.array_equal(peer.image().pixels, expected)
    peer.send("POSITION", "demo", pack_position(pose))
    assert np.array_equal(peer.image().pixels, expected)
    peer.send("POSITION", "demo", struct.pack(">3f", 3, 0, 0))
    assert np.array_equal(peer.image().pixels, expected)
    for type_name in ("TDATA", "QTDATA"):
        tools = [Instrument("Probe", pose), Instrument("Needle", np.eye(4))]  # no scene is named: the first
        peer.send(type_name, "Tracker", pack_instruments(type_name, tools))
        answer = peer.receive()
        assert answer.device_name == "Image_Probe"
        assert np.array_equal(unpack_image(answer.content).pixels, expected)


def test_an_answer_repeats_what_identifies_its_question(peer):
    peer.send_pose(np.eye(4), "demo", timestamp=77, version=2, message_id=5)
    answer = peer.receive()
    assert (answer.timestamp, answer.version, answer.message_id) == (77, 2, 5)
    assert answer.metadata["scene"] == "demo"
    assert answer.metadata["device"] == "demo"
    assert len(answer.metadata["scene_sha256"]) == 64
    assert answer.metadata["renderer"].startswith("ultragray/")
    assert answer.metadata["replaced_poses"] == "0"
    assert float(answer.metadata["render_ms"]) > 0


def test_a_newer_pose_replaces_one_that_waits(start_service, igtl_folder, connect):
    service = start_service(data_folder=igtl_folder, igtl_port=0, **SLOW)
    peer = connect(address_of(service))
    for x_mm in range(50):
        peer.send_pose(moved(x_mm / 10), "demo", version=2, message_id=x_mm)
    peer.send("GET_STATUS", "end")
    replaced, frames, last = 0, 0, 0
    while last < 49:
        answer = peer.receive()
        if answer.type_name == "IMAGE":
            assert answer.message_id >= last
            last, frames, replaced = answer.message_id, frames + 1, replaced + int(answer.metadata["replaced_poses"])
    assert np.array_equal(unpack_image(answer.content).pixels, over_grpc(service, "demo", moved(4.9)))
    assert frames + replaced == 50
    assert replaced > 20
    assert service.metric("ultragray_stream_dropped_poses_total") == replaced
    assert service.metric('ultragray_requests_total{door="igtl",route="TRANSFORM",status="OK"}') == frames


# Queries and streams


def test_capability_and_status(peer):
    answer = peer.ask("GET_CAPABIL")
    names = [answer.content[at : at + 12].rstrip(b"\0").decode() for at in range(0, len(answer.content), 12)]
    assert answer.type_name == "CAPABILITY"
    assert {"TRANSFORM", "QTDATA", "POSITION", "STT_QTDATA", "STP_QTDATA", "GET_IMAGE", "STT_TRANSFOR"} <= {*names}
    peer.send("GET_STATUS")
    assert (peer.status().code, peer.socket.getblocking()) == (1, True)


def test_queries_tell_the_newest_frame_of_any_client(connect, igtl_service):
    robot, viewer = connect(), connect()
    pose = random_pose(4)
    robot.send_pose(pose, "ProbeToReference", timestamp=9)
    frame = robot.image()
    exact = check_poses(pose)[0]
    answer = viewer.ask("GET_IMAGE", "Image_Reference")
    assert np.array_equal(unpack_image(answer.content).pixels, frame.pixels)
    assert (answer.device_name, answer.timestamp) == ("Image_Reference", 9)
    assert viewer.ask("GET_IMAGE", "").device_name == "Image_Reference"
    assert viewer.ask("GET_IMAGE", "another").content == b""
    for query in ("GET_TRANSFOR", "GET_TRANS"):
        assert unpack_transform(viewer.ask(query, "ProbeToReference").content) == pytest.approx(exact)
    assert unpack_position(viewer.ask("GET_POSITION", "").content) == pytest.approx(exact, abs=1e-6)
    (tool,) = unpack_instruments("QTDATA", viewer.ask("GET_QTDATA", "").content)
    assert tool.name == "ProbeToReference"
    assert tool.pose == pytest.approx(exact, abs=1e-6)


def test_a_viewer_is_sent_what_the_robot_sees(connect):
    robot, viewer, other = connect(), connect(), connect()
    for query in ("STT_IMAGE", "STT_TRANSFOR"):
        receipt = viewer.ask(query, "")
        assert (receipt.type_name, receipt.content) == (f"RTS_{query[4:]}", b"\0")
    assert other.ask("STT_IMAGE", "another device").content == b"\0"
    assert robot.ask("STT_IMAGE", "").content == b"\0"
    robot.send_pose(moved(1), "robot")
    frame = robot.image()
    answers = {answer.type_name: answer for answer in (viewer.receive(), viewer.receive())}
    assert np.array_equal(unpack_image(answers["IMAGE"].content).pixels, frame.pixels)
    assert answers["IMAGE"].device_name == "Image_robot"
    assert np.array_equal(unpack_transform(answers["TRANSFORM"].content), moved(1))
    assert viewer.ask("STP_IMAGE", "").type_name == "RTS_IMAGE"
    robot.send_pose(moved(2), "robot")
    robot.image()
    assert viewer.receive().type_name == "TRANSFORM"
    assert viewer.ask("GET_STATUS").type_name == "STATUS"  # nothing else came
    for client in (other, robot):  # a sender gets its images once
        assert client.ask("GET_STATUS").type_name == "STATUS"


def test_the_robot_is_told_its_own_poses(peer):
    assert peer.ask("STT_QTDATA", "", struct.pack(">I32s", 0, b"")).content == b"\0"
    peer.send_pose(moved(1))
    assert {peer.receive().type_name, peer.receive().type_name} == {"IMAGE", "QTDATA"}
    peer.send("STP_QTDATA")
    assert peer.receive().type_name == "RTS_QTDATA"


# Life of the service


def test_a_stop_answers_what_was_asked_and_is_told(start_service, igtl_folder, connect):
    service = start_service(data_folder=igtl_folder, igtl_port=0, **SLOW)
    busy, idle = connect(address_of(service)), connect(address_of(service))
    assert idle.ask("GET_STATUS").type_name == "STATUS"
    for name in ("demo", "second", "fan"):  # which loads them
        busy.send_pose(np.eye(4), name)
        busy.image()
    for name in ("demo", "second", "fan"):
        busy.send_pose(np.eye(4), name)
    answers = [busy.receive(), busy.receive()]
    assert service.terminate() == 0
    while answers[-1].device_name:
        answers.append(busy.receive())
    assert [answer.type_name for answer in answers[:2]] == ["IMAGE", "IMAGE"]
    assert len(answers) == 4  # the third was rendered, or refused
    for status in (unpack_status(answers[-1].content), idle.status()):
        assert (status.code, status.name) == (19, "DRAINING")
    assert busy.is_closed()
    assert idle.is_closed()


def test_a_port_in_use_stops_the_start(start_service, igtl_service):
    service = start_service(wait=False, igtl_port=address_of(igtl_service).rpartition(":")[2])
    assert service.process.wait(300) != 0
    assert (
        "the port is in use; give another one with --igtl-port or ULTRAGRAY_IGTL_PORT" in service.log_path.read_text()
    )


class SlowPeer:
    """A client that acknowledges nothing; timestamps number its poses."""

    def __init__(self, service, peer, device_name):
        self._peer, self._device_name, port = peer, device_name, peer.socket.getsockname()[1]
        self._poses = lambda: service.poses_from(port)

    def send(self, number):
        self._peer.send_pose(moved(0.0), self._device_name, timestamp=number << 32)
        wait_until(lambda: self._poses() == number)

    def receive(self):
        message = self._peer.receive()
        assert message.type_name == "IMAGE", unpack_status(message.content)
        return message.timestamp >> 32


@pytest.mark.parametrize(
    "scene", ["demo", *(pytest.param(scene, marks=pytest.mark.long) for scene in ("medium", "large"))]
)
def test_a_slow_reader_gets_no_old_image(start_service, igtl_folder, connect, scene):
    service = start_service(data_folder=igtl_folder, igtl_port=0, igtl_scene="demo", waits=WAITS)
    check_fresh(SlowPeer(service, connect(address_of(service)), scene), excused=1)
