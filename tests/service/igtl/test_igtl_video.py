"""VIDEO through real sockets: what a decoder makes of the frames is what IMAGE tells."""

import struct
import sys

import numpy as np
import pytest

from ultragray.errors import ExtraMissing
from ultragray_service.igtl.contents import (
    VideoFrame,
    pack_video,
    state_of,
    unpack_image,
    unpack_status,
)
from ultragray_service.igtl.video import VideoEncoder

from .conftest import moved, random_pose

HOUR_MS = 3_600_000
HEADER = struct.Struct(">HB4sHB3H12f6H")
KEY = 0x0100


def unpack_video(content):
    _, _, codec, kind, _, columns, rows, _, *numbers = HEADER.unpack_from(content)
    matrix = np.eye(4)
    matrix[:3] = np.reshape(numbers[:12], (4, 3)).T
    matrix[:3, 3] -= matrix[:3, :2] @ ((columns - 1) / 2, (rows - 1) / 2)  # from the centre to the first pixel
    return VideoFrame(codec.decode(), content[HEADER.size :], kind == KEY, (columns, rows), matrix)


class Viewer:
    """A peer that decodes the VIDEO messages that it is sent, in their order."""

    def __init__(self, peer):
        av = pytest.importorskip("av", reason="PyAV is not installed: pip install 'ultragray[video]'")
        self.peer = peer
        self._packet, self._decoder = av.Packet, av.CodecContext.create("vp9", "r")

    def subscribe(self, name="", interval_ms=0, codec=b"VP90", more=b""):
        answer = self.peer.ask("STT_VIDEO", name, struct.pack(">4sI", codec, interval_ms) + more)
        assert (answer.type_name, answer.content) == ("RTS_VIDEO", b"\0")

    def frame(self, message=None):
        """The next message, its frame, and the pixels [H, W] that a decoder makes of it."""
        message = message or self.peer.receive()
        assert message.type_name == "VIDEO", message
        frame = unpack_video(message.content)
        (decoded,) = self._decoder.decode(self._packet(frame.data))
        plane = decoded.planes[0]
        assert (plane.width, plane.height) == frame.size
        return message, frame, np.frombuffer(plane, np.uint8).reshape(plane.height, -1)[:, : plane.width]


def psnr_db(pixels, expected):
    return 10 * np.log10(255**2 / np.mean((pixels.astype(float) - expected) ** 2))


@pytest.mark.parametrize("scene", ["medium", "fan"])
def test_decoded_frames_are_those_of_images_in_their_place(connect, scene):
    robot, viewer = connect(), Viewer(connect())
    viewer.subscribe(f"ProbeTo{scene}", more=b"\1")  # older clients send a byte more
    for number in range(4):
        robot.send_pose(random_pose(number), f"ProbeTo{scene}", timestamp=number + 1)
        image = robot.image()
        message, frame, pixels = viewer.frame()
        assert (message.device_name, message.timestamp) == (f"Image_{scene}", number + 1)
        assert (frame.codec, frame.is_key) == ("VP90", number == 0)
        assert frame.size == image.pixels.shape[::-1]
        np.testing.assert_allclose(frame.matrix, image.matrix, atol=1e-4)
        assert psnr_db(pixels, image.pixels) >= 35
        assert len(frame.data) < image.pixels.size / 3


def test_who_asks_for_video_gets_it_in_place_of_its_own_images(connect):
    viewer = Viewer(connect())
    viewer.subscribe()
    viewer.peer.send_pose(moved(1), "medium", version=2, message_id=7)
    assert viewer.frame()[1].is_key
    viewer.peer.send_pose(moved(2), "medium")
    assert not viewer.frame()[1].is_key
    viewer.peer.send_pose(moved(2), "fan")
    message, frame, _ = viewer.frame()
    assert message.device_name == "Image_fan"
    assert frame.is_key, "an image of another size begins anew"
    assert viewer.peer.ask("STP_VIDEO", "").type_name == "RTS_VIDEO"
    viewer.peer.send_pose(moved(3), "medium")
    viewer.peer.image()


@pytest.mark.parametrize(("kind", "content"), [("IMAGE", b""), ("VIDEO", b"VP90")])
def test_a_client_chooses_the_least_time_between_frames(connect, kind, content):
    robot, viewer = connect(), connect()
    answer = viewer.ask(f"STT_{kind}", "", content + struct.pack(">I", HOUR_MS))
    assert answer.type_name == f"RTS_{kind}"
    for number in range(3):
        robot.send_pose(moved(number), "medium")
        robot.image()
        if number == 0:
            assert viewer.receive().type_name == kind
    assert viewer.ask(f"STP_{kind}", "").type_name == f"RTS_{kind}", "nothing else came within the hour"


def test_the_newest_frame_is_told_as_a_key_frame(connect):
    robot, viewer = connect(), Viewer(connect())
    robot.send_pose(moved(1), "medium")
    image = robot.image()
    for _ in range(2):
        _, frame, pixels = viewer.frame(viewer.peer.ask("GET_VIDEO", "Image_medium"))
        assert frame.is_key
        assert psnr_db(pixels, image.pixels) >= 35
    assert viewer.peer.ask("GET_VIDEO", "another").content == b""


def test_another_codec_is_refused_in_words(peer):
    for codec in (b"H264", b"\xff\xfe"):
        answer = peer.ask("STT_VIDEO", "demo", struct.pack(">4sI", codec, 0))
        status = unpack_status(answer.content)
        assert (answer.type_name, answer.device_name) == ("STATUS", "demo")
        assert (status.code, status.name) == (10, "INVALID_ARGUMENT")
        assert "the codec must be VP90 (VP9), got" in status.text
    assert peer.ask("STT_VIDEO", "demo", b"VP90\0").type_name == "STATUS"
    peer.send_pose(moved(0))
    peer.image()


def test_a_reader_of_video_that_stops_holds_up_nobody(connect):
    stopped, viewer, robot = connect(SO_RCVBUF=4096), Viewer(connect()), connect()
    Viewer(stopped).subscribe()
    viewer.subscribe()
    for number in range(60):
        robot.send_pose(random_pose(number), "large", timestamp=number + 1)
        image = robot.image()
    message, _, pixels = viewer.frame()
    while message.timestamp < 60:  # frames that this one was too slow for are left out, and the last one comes
        message, _, pixels = viewer.frame()
    assert psnr_db(pixels, unpack_image(robot.ask("GET_IMAGE", "Image_large").content).pixels) >= 35
    assert np.array_equal(image.pixels, unpack_image(robot.ask("GET_IMAGE", "large").content).pixels)


def test_without_the_extra_the_answer_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ExtraMissing, match=r"VIDEO needs av, which is not installed: .*ultragray\[video\]") as caught:
        VideoEncoder("VP90")
    assert state_of(caught.value).name == "EXTRA_MISSING"


def test_the_header_is_that_of_the_protocol():
    matrix = np.eye(4)
    matrix[:3, 3] = (1.0, 2.0, 3.0)
    packed = pack_video(VideoFrame("VP90", b"data", True, (3, 5), matrix))
    centre = struct.pack(">3f", 2.0, 4.0, 3.0)
    axes = struct.pack(">9f", 1, 0, 0, 0, 1, 0, 0, 0, 1)
    assert packed == (
        b"\0\1"  # version of the header
        b"\2"  # little endian
        b"VP90"
        b"\1\0"  # key frame of a grey stream
        b"\1"  # RAS
        b"\0\3\0\5\0\1" + axes + centre + b"\0\0\0\0\0\0" + b"\0\3\0\5\0\1" + b"data"
    )
    assert len(packed) == 76 + 4
