from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable

import numpy as np
import pyigtl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ultragray.errors import InvalidPose, UltragrayError
from ultragray.geometry.pose import check_poses
from ultragray_service.errors import IgtlMessageInvalid
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

from .conftest import random_pose

QUARTER_TURN = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])  # about z, then to (1, 2, 3)
HALF = 0.5**0.5


def test_a_transform_is_written_column_by_column() -> None:
    content = pack_transform(QUARTER_TURN)
    assert struct.unpack(">12f", content) == (0, 1, 0, -1, 0, 0, 0, 0, 1, 1, 2, 3)
    assert content == pyigtl.TransformMessage(QUARTER_TURN)._pack_content()
    assert np.array_equal(unpack_transform(content), QUARTER_TURN)


@given(st.integers(0, 2**32))
def test_transforms_round_trip(seed: int) -> None:
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
def test_the_forms_of_a_position(numbers: tuple[float, ...], expected: np.ndarray) -> None:
    pose = unpack_position(struct.pack(f">{len(numbers)}f", *numbers))
    assert pose == pytest.approx(expected, abs=1e-7)


@given(st.integers(0, 2**32))
def test_positions_and_tools_round_trip(seed: int) -> None:
    pose, other = check_poses(random_pose(seed))[0], check_poses(random_pose(seed + 1))[0]
    assert unpack_position(pack_position(pose)) == pytest.approx(pose, abs=1e-5)
    for type_name, element in (("TDATA", 70), ("QTDATA", 50)):
        content = pack_instruments(type_name, [Instrument("Probe", pose), Instrument("Needle", other)])
        assert len(content) == 2 * element
        tools = unpack_instruments(type_name, content)
        assert [tool.name for tool in tools] == ["Probe", "Needle"]
        assert tools[0].pose == pytest.approx(pose, abs=1e-5)
        assert tools[1].pose == pytest.approx(other, abs=1e-5)


def test_tools_without_orientation_are_left_out() -> None:
    content = bytearray(pack_instruments("QTDATA", [Instrument("Tip", np.eye(4)), Instrument("Probe", np.eye(4))]))
    content[20] = 3  # a 3D instrument
    assert [tool.name for tool in unpack_instruments("QTDATA", bytes(content))] == ["Probe"]


@pytest.mark.parametrize("lost", [0.0, float("nan")])
def test_a_tool_that_the_tracker_lost_costs_the_probe_nothing(lost: float) -> None:
    content = pack_instruments("TDATA", [Instrument("Probe", np.eye(4))])
    content += struct.pack(">20sBB12f", b"Needle", 2, 0, *[lost] * 12)
    assert [one.name for one in unpack_instruments("TDATA", content, lambda name: name == "Needle")] == ["Probe"]
    with pytest.raises(InvalidPose, match="TDATA of 'Needle'"):
        unpack_instruments("TDATA", content)


def test_what_is_no_pose_is_refused() -> None:
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


UNPACKERS: list[Callable[[bytes], object]] = [
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
def test_any_content_is_read_or_refused(unpack: Callable[[bytes], object], content: bytes) -> None:
    with contextlib.suppress(UltragrayError):
        unpack(content)


@pytest.mark.parametrize("unpack", UNPACKERS)
def test_sizes_that_cannot_be_are_told(unpack: Callable[[bytes], object]) -> None:
    with pytest.raises(IgtlMessageInvalid, match="got 3"):
        unpack(bytes(3))


def test_an_image_is_as_pyigtl_writes_it() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (5, 8), np.uint8)
    matrix = QUARTER_TURN @ np.diag([0.5, 0.25, 1.0, 1.0])
    content = pack_image(Image(pixels, matrix))
    assert content == pyigtl.ImageMessage(pixels[None], matrix, "ras")._pack_content()
    image = unpack_image(content)
    assert np.array_equal(image.pixels, pixels)
    assert image.matrix == pytest.approx(matrix)


def test_an_image_that_is_not_one_slice_of_bytes_is_refused() -> None:
    for array in (np.zeros((2, 3, 4), np.uint8), np.zeros((1, 3, 4), np.uint16), np.zeros((1, 3, 4, 3), np.uint8)):
        with pytest.raises(IgtlMessageInvalid, match="8-bit"):
            unpack_image(pyigtl.ImageMessage(array)._pack_content())
    with pytest.raises(IgtlMessageInvalid, match="84 bytes, got 83"):
        unpack_image(pyigtl.ImageMessage(np.zeros((1, 3, 4), np.uint8))._pack_content()[:-1])


def test_status_and_capability() -> None:
    status = Status(12, 400, "IGTL_MESSAGE_INVALID", "no")
    content = pack_status(status)
    assert struct.unpack_from(">Hq", content) == (12, 400)
    assert unpack_status(content) == Status(12, 400, "IGTL_MESSAGE_INVALI", "no")  # 19 letters and a NUL
    assert pack_capability(["TRANSFORM", "STT_TRANSFOR"]) == b"TRANSFORM\0\0\0STT_TRANSFOR"


def test_intervals() -> None:
    assert unpack_interval_s(b"") == 0.0
    assert unpack_interval_s(struct.pack(">I32s", 50, b"Reference")) == 0.05
