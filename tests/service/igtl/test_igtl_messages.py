"""OpenIGTLink without a service: messages, what they hold, their names, and poses that wait for their frames."""

import asyncio
import contextlib
import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyigtl
import pytest
import torch
from fastcrc import crc64
from hypothesis import given
from hypothesis import strategies as st
from pyigtl.messages import MessageBase

from ultragray import LinearProbe
from ultragray.errors import InvalidPose, UltragrayError
from ultragray.geometry.pose import check_poses
from ultragray.geometry.registration import Registration, rows
from ultragray.geometry.scan_conversion import scan_convert
from ultragray.rendering.display import true_to_scale
from ultragray.rendering.frames import show
from ultragray.rendering.settings import FrameSettings, Resolved
from ultragray.scene.confidence import Extrapolation
from ultragray_service.core.scenes import SceneCatalog
from ultragray_service.errors import IgtlMessageInvalid
from ultragray_service.igtl.commands import Setup
from ultragray_service.igtl.contents import (
    Image,
    Instrument,
    Status,
    pack_capability,
    pack_image,
    pack_instruments,
    pack_position,
    pack_status,
    pack_transform,
    unpack_image,
    unpack_instruments,
    unpack_interval_s,
    unpack_position,
    unpack_status,
    unpack_transform,
)
from ultragray_service.igtl.frames import MAX_WAITING_DEVICES, Feed, PoseMessage, WaitingPoses, image_of
from ultragray_service.igtl.messages import (
    DEVICE_NAME_BYTES,
    HEADER_BYTES,
    Header,
    Message,
    pack_message,
    pack_text,
    unpack_header,
    unpack_message,
)
from ultragray_service.igtl.routes import SceneChooser, device_of, frame_of, image_name
from ultragray_workers.errors import QueueFull, SceneNotFound
from ultragray_workers.pool.messages import RenderResult
from ultragray_workers.scenes import SceneStore

from .conftest import FAN, random_pose

IMAGE = np.arange(12, dtype=np.uint8).reshape(1, 3, 4)
THEIRS = {
    "TRANSFORM": lambda: pyigtl.TransformMessage(np.diag([1.0, -1, -1, 1]), device_name="Probe", timestamp=2.5),
    "IMAGE": lambda: pyigtl.ImageMessage(IMAGE, device_name="Probe", timestamp=2.5),
    "STRING": lambda: pyigtl.StringMessage("hello", device_name="Probe", timestamp=2.5),
}


def unpacked(data):
    header = unpack_header(data[:HEADER_BYTES])
    assert header.body_bytes == len(data) - HEADER_BYTES
    return unpack_message(header, data[HEADER_BYTES:])


@pytest.mark.parametrize("type_name", THEIRS)
@pytest.mark.parametrize("version", [1, 2])
def test_what_pyigtl_packs_we_read(type_name, version):
    theirs = THEIRS[type_name]()
    theirs.header_version = version
    if version == 2:
        theirs.message_id = 7
        theirs.metadata = {"depth": "40", "empty": ""}
    message = unpacked(theirs.pack())
    assert (message.type_name, message.device_name) == (type_name, "Probe")
    assert message.timestamp == 2 << 32 | 1 << 31
    assert message.content == theirs._pack_content()
    assert (message.version, message.message_id) == (version, theirs.message_id)
    assert message.metadata == theirs.metadata


@pytest.mark.parametrize("version", [1, 2])
def test_what_we_pack_pyigtl_reads(version):
    metadata = {"scene": "demo", "renderer": "x"} if version == 2 else {}
    content = pyigtl.TransformMessage(np.eye(4))._pack_content()
    packed = pack_message(Message("TRANSFORM", "Probe", content, 5 << 32, version, 7 * (version - 1), metadata))
    theirs = MessageBase.create_message("TRANSFORM")
    theirs.unpack(MessageBase.parse_header(packed[:HEADER_BYTES]), packed[HEADER_BYTES:])
    assert (theirs.device_name, theirs.timestamp, theirs.metadata) == ("Probe", 5.0, metadata)
    assert (theirs.header_version, theirs.message_id) == (version, 7 * (version - 1))
    assert np.array_equal(theirs.matrix, np.eye(4))
    assert crc64.ecma_182(packed[HEADER_BYTES:]) == int.from_bytes(packed[50:58], "big")


texts = st.text(st.characters(exclude_categories=("C", "Z")), max_size=12)


@given(
    st.sampled_from(["TRANSFORM", "QTDATA", "X"]),
    texts.filter(lambda text: len(text.encode()) <= DEVICE_NAME_BYTES),
    st.binary(max_size=300),
    st.integers(0, 2**64 - 1),
    st.integers(0, 2**32 - 1),
    st.dictionaries(texts, texts, max_size=3),
)
def test_round_trip(type_name, device_name, content, timestamp, message_id, metadata):
    for message in (
        Message(type_name, device_name, content, timestamp),
        Message(type_name, device_name, content, timestamp, 2, message_id, metadata),
    ):
        assert unpacked(pack_message(message)) == message


@given(st.binary(min_size=HEADER_BYTES, max_size=HEADER_BYTES))
def test_any_bytes_are_a_header_or_refused(data):
    with contextlib.suppress(IgtlMessageInvalid):
        assert unpack_header(data).version in (1, 2)


@given(st.binary(max_size=80))
def test_any_bytes_are_a_body_or_refused(body):
    header = Header(2, "TRANSFORM", "Probe", 0, len(body), crc64.ecma_182(body))
    with contextlib.suppress(IgtlMessageInvalid):
        assert len(unpack_message(header, body).content) <= len(body) - 12


def test_metadata_that_reaches_beyond_the_body_is_refused():
    data = bytearray(pack_message(Message("TRANSFORM", "Probe", b"", version=2, metadata={"key": "value"})))
    body = data[HEADER_BYTES:]
    body[14:16] = (200).to_bytes(2, "big")  # the size of the key
    header = Header(2, "TRANSFORM", "Probe", 0, len(body), crc64.ecma_182(body))
    with pytest.raises(IgtlMessageInvalid, match="metadata"):
        unpack_message(header, bytes(body))


def test_names_are_cut_between_characters():
    assert pack_text("Sonde für Leber, rechts", 20) == "Sonde für Leber, re".encode()
    assert pack_text("ü" * 11, 20) == ("ü" * 10).encode()
    assert pack_text("ü" * 11, 19) == ("ü" * 9).encode()


QUARTER_TURN = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])  # about z, then to (1, 2, 3)
HALF = 0.5**0.5


def test_a_transform_is_written_column_by_column():
    content = pack_transform(QUARTER_TURN)
    assert struct.unpack(">12f", content) == (0, 1, 0, -1, 0, 0, 0, 0, 1, 1, 2, 3)
    assert content == pyigtl.TransformMessage(QUARTER_TURN)._pack_content()
    assert np.array_equal(unpack_transform(content), QUARTER_TURN)


@given(st.integers(0, 2**32))
def test_transforms_round_trip(seed):
    pose = random_pose(seed)
    assert np.array_equal(unpack_transform(pack_transform(pose)), check_poses(pose)[0])


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ((1, 2, 3), np.array([[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])),
        ((1, 2, 3, 0, 0, HALF), QUARTER_TURN),
        ((1, 2, 3, 0, 0, HALF, HALF), QUARTER_TURN),
        ((1, 2, 3, 0, 0, -HALF, -HALF), QUARTER_TURN),
    ],
)
def test_the_forms_of_a_position(numbers, expected):
    pose = unpack_position(struct.pack(f">{len(numbers)}f", *numbers))
    assert pose == pytest.approx(expected, abs=1e-7)


@given(st.integers(0, 2**32))
def test_positions_and_tools_round_trip(seed):
    pose, other = check_poses(random_pose(seed))[0], check_poses(random_pose(seed + 1))[0]
    assert unpack_position(pack_position(pose)) == pytest.approx(pose, abs=1e-5)
    for type_name, element in (("TDATA", 70), ("QTDATA", 50)):
        content = pack_instruments(type_name, [Instrument("Probe", pose), Instrument("Needle", other)])
        assert len(content) == 2 * element
        tools = unpack_instruments(type_name, content)
        assert [tool.name for tool in tools] == ["Probe", "Needle"]
        assert tools[0].pose == pytest.approx(pose, abs=1e-5)
        assert tools[1].pose == pytest.approx(other, abs=1e-5)


def test_tools_without_orientation_are_left_out():
    content = bytearray(pack_instruments("QTDATA", [Instrument("Tip", np.eye(4)), Instrument("Probe", np.eye(4))]))
    content[20] = 3  # a 3D instrument
    assert [tool.name for tool in unpack_instruments("QTDATA", bytes(content))] == ["Probe"]


@pytest.mark.parametrize("lost", [0.0, float("nan")])
def test_a_tool_that_the_tracker_lost_costs_the_probe_nothing(lost):
    content = pack_instruments("TDATA", [Instrument("Probe", np.eye(4))])
    content += struct.pack(">20sBB12f", b"Needle", 2, 0, *[lost] * 12)
    assert [one.name for one in unpack_instruments("TDATA", content, lambda name: name == "Needle")] == ["Probe"]
    with pytest.raises(InvalidPose, match="TDATA of 'Needle'"):
        unpack_instruments("TDATA", content)


def test_what_is_no_pose_is_refused():
    mirror = np.diag([1.0, 1, -1, 1])
    with pytest.raises(InvalidPose, match="TRANSFORM must hold a rotation"):
        unpack_transform(pack_transform(mirror))
    with pytest.raises(InvalidPose, match="finite"):
        unpack_transform(struct.pack(">12f", *[float("nan")] * 12))
    with pytest.raises(InvalidPose, match="norm 1"):
        unpack_position(struct.pack(">7f", 0, 0, 0, 1, 1, 1, 1))
    with pytest.raises(InvalidPose, match="norm 1"):
        unpack_position(struct.pack(">6f", 0, 0, 0, 1, 1, 1))
    with pytest.raises(InvalidPose, match="QTDATA of 'Probe'"):
        unpack_instruments("QTDATA", struct.pack(">20sBB7f", b"Probe", 2, 0, *[0.0] * 7))


UNPACKERS = [
    unpack_transform,
    unpack_position,
    lambda content: unpack_instruments("TDATA", content),
    lambda content: unpack_instruments("QTDATA", content),
    unpack_image,
    unpack_status,
    unpack_interval_s,
]


@pytest.mark.parametrize("unpack", UNPACKERS)
@given(content=st.binary(max_size=160))
def test_any_content_is_read_or_refused(unpack, content):
    with contextlib.suppress(UltragrayError):
        unpack(content)


@pytest.mark.parametrize("unpack", UNPACKERS)
def test_sizes_that_cannot_be_are_told(unpack):
    with pytest.raises(IgtlMessageInvalid, match="got 3"):
        unpack(bytes(3))


def test_an_image_is_as_pyigtl_writes_it():
    pixels = np.random.default_rng(0).integers(0, 256, (5, 8), np.uint8)
    matrix = QUARTER_TURN @ np.diag([0.5, 0.25, 1.0, 1.0])
    content = pack_image(Image(pixels, matrix))
    assert content == pyigtl.ImageMessage(pixels[None], matrix, "ras")._pack_content()
    image = unpack_image(content)
    assert np.array_equal(image.pixels, pixels)
    assert image.matrix == pytest.approx(matrix)


def test_status_and_capability():
    status = Status(12, 400, "IGTL_MESSAGE_INVALID", "no")
    content = pack_status(status)
    assert struct.unpack_from(">Hq", content) == (12, 400)
    assert unpack_status(content) == Status(12, 400, "IGTL_MESSAGE_INVALI", "no")  # 19 letters and a NUL
    assert pack_capability(["TRANSFORM", "STT_TRANSFOR"]) == b"TRANSFORM\0\0\0STT_TRANSFOR"


def result_of(frame, probe, pose, max_side=2048):
    """As the pool answers it."""
    display = true_to_scale(probe, frame.shape[0], max_side)
    shown = show({"bmode": torch.from_numpy(frame[None])}, probe, display)["bmode"][0].numpy()
    return RenderResult(
        scene="demo",
        scene_sha256="",
        renderer="",
        poses=pose[None],
        settings=Resolved(probe, *frame.shape, display=display),
        data=shown.tobytes(),
        queue_ms=0,
        render_ms=0,
        encode_ms=0,
        extrapolations=(Extrapolation(None, None, None, None),),
        batch_size=1,
    )


def spot(shape, row, column):
    frame = np.zeros(shape, np.uint8)
    frame[row - 1 : row + 2, column - 1 : column + 2] = 100
    frame[row, column] = 255
    return frame


def place_of_brightest(image):
    j, i = np.unravel_index(int(np.argmax(image.pixels)), image.pixels.shape)
    return (image.matrix @ (i, j, 0, 1))[:3]


@pytest.mark.parametrize("probe", [LinearProbe(38.0, 5.0, 50.0), FAN])
@pytest.mark.parametrize(("row", "column"), [(20, 10), (50, 90), (90, 50)])
def test_a_spot_is_where_the_probe_says(probe, row, column):
    pose = random_pose(3)
    image = image_of(result_of(spot((100, 100), row, column), probe, pose))
    origins, directions = probe.scan_lines(100)
    along = probe.depths_mm(100)[row]
    expected = (pose @ np.append(origins[column] + along * directions[column], 1.0))[:3]
    assert np.linalg.norm(place_of_brightest(image) - expected) < 0.4  # a pixel's diagonal


def test_a_linear_frame_is_sent_as_it_is():
    frame = np.random.default_rng(0).integers(0, 256, (30, 20), np.uint8)
    image = image_of(result_of(frame, LinearProbe(40.0, 0.0, 60.0), np.eye(4)))
    assert np.array_equal(image.pixels, frame)
    expected = [[2, 0, 0, -19], [0, 0, -1, 0], [0, 2, 0, 1], [0, 0, 0, 1]]
    assert np.array_equal(image.matrix, expected)
    assert np.linalg.det(image.matrix[:3, :3]) > 0


def test_a_fan_is_scan_converted():
    frame = np.random.default_rng(0).integers(0, 256, (80, 60), np.uint8)
    image = image_of(result_of(frame, FAN, np.eye(4)))
    expected = scan_convert(frame, FAN, 0.5)  # 40 mm in 80 samples
    assert image.pixels.shape == expected.shape
    assert np.abs(image.pixels - expected).max() <= 0.51
    assert (image.pixels[expected == 0] == 0).all()
    assert image.matrix[:3, :2] == pytest.approx(np.array([[0.5, 0], [0, 0], [0, 0.5]]))
    top_mm = FAN.near_mm * math.cos(math.radians(30))
    assert image.matrix[2, 3] == pytest.approx(top_mm + 0.25)


@pytest.mark.parametrize(
    ("device", "frame", "image"),
    [
        ("ProbeToReference", "Reference", "Image_Reference"),
        ("MyToolToTracker", "Tracker", "Image_Tracker"),
        ("StylusTipToTorso", "Torso", "Image_Torso"),
        ("ProbeToliver", "liver", "Image_liver"),
        ("liver", "liver", "Image_liver"),
        ("ToReference", "ToReference", "Image_ToReference"),
        ("ProbeTo", "ProbeTo", "Image_ProbeTo"),
        ("", "", "Image_"),
        ("abcdefghijklmnopqrst", "abcdefghijklmnopqrst", "Image_abcdefghijklmn"),
    ],
)
def test_names(device, frame, image):
    assert (frame_of(device), image_name(device)) == (frame, image)


@pytest.mark.parametrize(
    ("scene", "device"),
    [
        ("liver", "ProbeToliver"),
        ("exactly-13-by", "ProbeToexactly-13-by"),
        ("fourteen-bytes", "fourteen-bytes"),
        ("aTo3", "aTo3"),  # ProbeToaTo3 would be of a scene called 3
        ("a-name-of-20-letters", "a-name-of-20-letters"),
        ("a-name-of-twenty-one-b", "ProbeToReference"),
    ],
)
def test_a_scene_has_a_device_that_names_it(scene, device):
    assert device_of(scene) == device
    assert device == "ProbeToReference" or scene in (device, frame_of(device))


def chooser(folder, *names, default=None):
    for name in names:
        (folder / f"{name}.ugr").touch()
    return SceneChooser(SceneCatalog(SceneStore(folder)), default)


async def test_the_device_chooses_else_the_default_else_the_only_one(tmp_path):
    async def choices(one, *devices):
        return [await one.choose(device) for device in devices]

    only = chooser(tmp_path, "liver")
    assert await choices(only, "ProbeToReference", "liver") == ["liver", "liver"]
    several = chooser(tmp_path, "spine", default="spine")
    devices = ("ProbeToReference", "liver", "ProbeToliver", "Liver")
    assert await choices(several, *devices) == ["spine", "liver", "liver", "spine"]
    with pytest.raises(SceneNotFound, match="ULTRAGRAY_IGTL_SCENE"):
        await chooser(tmp_path).choose("ProbeToReference")


SETUP = Setup(FrameSettings())


@dataclass
class FakeTurn:
    """Of a request that still waits in the pool."""

    poses: Any = None

    def give_to(self, poses, deadline):
        self.poses = poses
        return True


def waits_in_the_pool(underway):
    underway.pending, underway.setup = (turn := FakeTurn()), SETUP
    return turn


def posed(device_name, x_mm=0.0):
    pose = np.eye(4)
    pose[0, 3] = x_mm
    return PoseMessage(Message("TRANSFORM", device_name), pose, 0.0)


async def taken(waiting):
    await waiting.come()
    return waiting.take()


async def test_each_device_has_its_turn_with_its_newest_pose():
    waiting = WaitingPoses()
    replaced = [waiting.put(posed(name, x_mm), 0.0, SETUP) for name, x_mm in (("a", 1), ("b", 2), ("a", 3), ("a", 4))]
    assert replaced == [False, False, True, True]
    first, second = (await taken(waiting)).posed, (await taken(waiting)).posed
    assert (first.message.device_name, first.pose[0, 3], first.replaced) == ("a", 4, 2)
    assert (second.message.device_name, second.pose[0, 3], second.replaced) == ("b", 2, 0)


async def test_a_newer_pose_takes_the_turn_of_one_that_waits_in_the_pool():
    waiting = WaitingPoses()
    waiting.put(posed("a", 1), 0.0, SETUP)
    underway = await taken(waiting)
    assert not waiting.put(posed("a", 2), 0.0, SETUP)  # it is being rendered
    turn = waits_in_the_pool(underway)
    assert waiting.put(posed("a", 3), 0.0, SETUP)  # of the two that wait here, the older one
    assert turn.poses is None
    underway = await taken(waiting)
    assert underway.posed.pose[0, 3] == 3
    turn = waits_in_the_pool(underway)
    assert not waiting.put(posed("b", 4), 0.0, SETUP)
    assert waiting.put(posed("a", 5), 0.0, SETUP)
    assert turn.poses[0, 0, 3] == 5
    assert (underway.posed.pose[0, 3], underway.posed.replaced) == (5, 2)


async def test_a_pose_does_not_take_the_turn_of_one_with_another_setup():
    waiting = WaitingPoses()
    waiting.put(posed("a", 1), 0.0, SETUP)
    underway = await taken(waiting)
    turn = waits_in_the_pool(underway)
    waiting.again(posed("a", 1))  # a tool has moved
    waiting.again(posed("a", 1))
    assert waiting.put(posed("a", 2), 0.0, Setup(FrameSettings()))
    assert turn.poses is None
    underway = await taken(waiting)
    assert underway.posed.pose[0, 3] == 2
    turn = waits_in_the_pool(underway)
    assert not waiting.put(posed("a", 3), 0.0, Setup(FrameSettings()))
    assert turn.poses is None


async def test_a_pose_that_takes_a_turn_is_led_as_the_one_before():
    waiting = WaitingPoses()
    waiting.put(posed("a", 1), 0.0, SETUP)
    underway = await taken(waiting)
    turn = waits_in_the_pool(underway)
    underway.registration = Registration(base_to_scene=rows(posed("a", 10).pose))
    assert underway.pose[0, 3] == 11
    assert waiting.put(posed("a", 5), 0.0, SETUP)
    assert turn.poses[0, 0, 3] == 15


async def test_devices_without_end_are_refused():
    waiting = WaitingPoses()
    for number in range(MAX_WAITING_DEVICES):
        waiting.put(posed(str(number)), 0.0, SETUP)
    assert waiting.put(posed("0"), 0.0, SETUP)
    with pytest.raises(QueueFull, match="16 devices"):
        waiting.put(posed("one more"), 0.0, SETUP)


async def test_settled_is_when_nothing_waits_and_nothing_is_under_way():
    waiting = WaitingPoses()
    await waiting.settled()
    waiting.put(posed("a"), 0.0, SETUP)
    await taken(waiting)
    settled = asyncio.ensure_future(waiting.settled())
    await asyncio.sleep(0)
    assert not settled.done()
    more = asyncio.ensure_future(taken(waiting))
    await settled
    more.cancel()


class _FrameOf:
    """A frame that goes by any name."""

    def goes_by(self, name):
        return True

    def message(self, kind, version):
        return Message(kind, "robot", version=version)


async def test_a_subscriber_is_told_at_most_as_often_as_it_asks(clock):
    told = []

    async def send(message):
        told.append(clock.now)

    feed = Feed(contextlib.nullcontext, send)
    feed.start("QTDATA", "", 0.3, 1)
    running = asyncio.ensure_future(feed.run())
    for _ in range(100):
        feed.offer(_FrameOf(), is_own=True)
        await asyncio.sleep(0.01)
    feed.stop("QTDATA")
    await asyncio.sleep(1.0)
    running.cancel()
    assert told == pytest.approx([1000.0, 1000.3, 1000.6, 1000.9], abs=0.02)
