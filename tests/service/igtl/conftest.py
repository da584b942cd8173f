"""A real service with OpenIGTLink, and a client that speaks through a socket."""

import socket
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pyigtl
import pytest

from ultragray import ConvexProbe, GaussianScene
from ultragray.learn.motion import add_motion
from ultragray.scene.motion_settings import MotionSettings
from ultragray_service.igtl.contents import pack_transform, unpack_image, unpack_status
from ultragray_service.igtl.messages import HEADER_BYTES, Message, pack_message, unpack_header, unpack_message

from ...waiting import wait_until
from ..conftest import DEMO_PROBE, make_scene

TIMEOUT_S = 300.0
FAN = ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=60.0)


class Peer:
    """One connection, blocking."""

    def __init__(self, address, *, source="", **options):
        host, port = address.rsplit(":", 1)
        self.socket = socket.socket()
        if source:
            self.socket.bind((source, 0))
        for option, value in options.items():
            self.socket.setsockopt(socket.SOL_SOCKET, getattr(socket, option), value)
        self.socket.settimeout(TIMEOUT_S)
        self.socket.connect((host, int(port)))

    def send(self, type_name, device_name="demo", content=b"", **more):
        self.socket.sendall(pack_message(Message(type_name, device_name, content, **more)))

    def send_pose(self, pose, device_name="demo", **more):
        self.send("TRANSFORM", device_name, pack_transform(pose), **more)

    def receive(self):
        header = unpack_header(self._exactly(HEADER_BYTES))
        return unpack_message(header, self._exactly(header.body_bytes))

    def image(self):
        message = self.receive()
        assert message.type_name == "IMAGE", unpack_status(message.content)
        return unpack_image(message.content)

    def status(self):
        message = self.receive()
        assert message.type_name == "STATUS"
        return unpack_status(message.content)

    def ask(self, type_name, device_name="demo", content=b"", **more):
        self.send(type_name, device_name, content, **more)
        return self.receive()

    def is_closed(self):
        try:
            return self.socket.recv(1) == b""
        except ConnectionError:
            return True

    def _exactly(self, count):
        data = b""
        while len(data) < count:
            chunk = self.socket.recv(count - len(data))
            if not chunk:
                raise ConnectionResetError(f"closed after {len(data)} of {count} bytes")
            data += chunk
        return data


@pytest.fixture(scope="session")
def igtl_folder(data_folder, tmp_path_factory):
    """Linear scenes (images of `medium` are 128x128, of `large` 512x512), `fan` of a convex probe, and `breathing`."""
    folder = tmp_path_factory.mktemp("igtl")
    for name in ("demo", "second"):
        (folder / f"{name}.ugr").write_bytes((data_folder / f"{name}.ugr").read_bytes())
    demo = make_scene(probe=DEMO_PROBE)
    for name, side in (("medium", 128), ("large", 512)):
        info = replace(demo.info, image_height=side, image_width=side)
        GaussianScene.from_splats(demo.splats, info=info).save(folder / f"{name}.ugr")
    make_scene(seed=2, probe=FAN).save(folder / "fan.ugr")
    add_motion(demo, MotionSettings(chest_mm=6.0)).scene.save(folder / "breathing.ugr")
    return folder


@pytest.fixture(scope="session")
def igtl_service(start_shared_service, igtl_folder):
    return start_shared_service(data_folder=igtl_folder, igtl_port=0, igtl_scene="demo")


def address_of(service):
    return str(next(record["igtl"] for record in service.log() if "igtl" in record))


@pytest.fixture
def connect(igtl_service):
    """Opens connections to the shared service; all are closed after the test."""
    peers = []

    def open_one(address=None, **options):
        peers.append(Peer(address or address_of(igtl_service), **options))
        return peers[-1]

    yield open_one
    for peer in peers:
        peer.socket.close()


@pytest.fixture
def peer(connect):
    return connect()


@contextmanager
def pyigtl_client(address):
    host, port = address.rsplit(":", 1)
    client = pyigtl.OpenIGTLinkClient(host, int(port))
    try:
        wait_until(client.is_connected)
        yield client
    finally:
        client.stop()


def moved(x_mm):
    pose = np.eye(4)
    pose[0, 3] = x_mm
    return pose


def random_pose(seed):
    """A pose [4, 4] mm near the scenes of the tests, as exact as float32 numbers are."""
    from ultragray.geometry.pose import pose_from_position_quaternion

    rng = np.random.default_rng(seed)
    quaternion = np.array([1.0, 0.0, 0.0, 0.0]) + rng.normal(0, 0.1, 4)
    pose = pose_from_position_quaternion(tuple(rng.normal(0, 2, 3)), tuple(quaternion / np.linalg.norm(quaternion)))
    return pose.astype(np.float32).astype(np.float64)
