from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import pyigtl
import pytest
from fastcrc import crc64
from hypothesis import given
from hypothesis import strategies as st
from pyigtl.messages import MessageBase

from ultragray_service.errors import IgtlMessageInvalid
from ultragray_service.igtl.contents import unpack_image, unpack_transform
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

IMAGE = np.arange(12, dtype=np.uint8).reshape(1, 3, 4)
THEIRS: dict[str, Any] = {
    "TRANSFORM": lambda: pyigtl.TransformMessage(np.diag([1.0, -1, -1, 1]), device_name="Probe", timestamp=2.5),
    "IMAGE": lambda: pyigtl.ImageMessage(IMAGE, device_name="Probe", timestamp=2.5),
    "STRING": lambda: pyigtl.StringMessage("hello", device_name="Probe", timestamp=2.5),
    "POINT": lambda: pyigtl.PointMessage([[1, 2, 3]], device_name="Probe", timestamp=2.5),
    "POSITION": lambda: pyigtl.PositionMessage([[1, 2, 3]], [[0, 0, 0, 1]], device_name="Probe", timestamp=2.5),
    "POLYDATA": lambda: pyigtl.PolyDataMessage(
        points=np.zeros((3, 3)), polygons=np.array([3, 0, 1, 2]), device_name="Probe", timestamp=2.5
    ),
}


def unpack(data: bytes) -> Message:
    header = unpack_header(data[:HEADER_BYTES])
    assert header.body_bytes == len(data) - HEADER_BYTES
    return unpack_message(header, data[HEADER_BYTES:])


@pytest.mark.parametrize("type_name", THEIRS)
@pytest.mark.parametrize("version", [1, 2])
def test_what_pyigtl_packs_we_read(type_name: str, version: int) -> None:
    theirs = THEIRS[type_name]()
    theirs.header_version = version
    if version == 2:
        theirs.message_id = 7
        theirs.metadata = {"depth": "40", "empty": ""}
    message = unpack(theirs.pack())
    assert (message.type_name, message.device_name) == (type_name, "Probe")
    assert message.timestamp == 2 << 32 | 1 << 31
    assert message.content == theirs._pack_content()
    assert (message.version, message.message_id) == (version, theirs.message_id)
    assert message.metadata == theirs.metadata


def test_contents_that_pyigtl_packs() -> None:
    assert np.array_equal(unpack_transform(unpack(THEIRS["TRANSFORM"]().pack()).content), np.diag([1.0, -1, -1, 1]))
    image = unpack_image(unpack(THEIRS["IMAGE"]().pack()).content)
    assert np.array_equal(image.pixels, IMAGE[0])
    assert np.array_equal(image.matrix, np.eye(4))


@pytest.mark.parametrize("version", [1, 2])
def test_what_we_pack_pyigtl_reads(version: int) -> None:
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
def test_round_trip(
    type_name: str, device_name: str, content: bytes, timestamp: int, message_id: int, metadata: dict[str, str]
) -> None:
    for message in (
        Message(type_name, device_name, content, timestamp),
        Message(type_name, device_name, content, timestamp, 2, message_id, metadata),
    ):
        assert unpack(pack_message(message)) == message


@given(st.binary(min_size=HEADER_BYTES, max_size=HEADER_BYTES))
def test_any_bytes_are_a_header_or_refused(data: bytes) -> None:
    with contextlib.suppress(IgtlMessageInvalid):
        assert unpack_header(data).version in (1, 2)


@given(st.binary(max_size=80))
def test_any_bytes_are_a_body_or_refused(body: bytes) -> None:
    header = Header(2, "TRANSFORM", "Probe", 0, len(body), crc64.ecma_182(body))
    with contextlib.suppress(IgtlMessageInvalid):
        assert len(unpack_message(header, body).content) <= len(body) - 12


def test_a_wrong_checksum_is_refused() -> None:
    data = bytearray(pack_message(Message("TRANSFORM", "Probe", bytes(48))))
    data[-1] ^= 1
    with pytest.raises(IgtlMessageInvalid, match="CRC-64") as caught:
        unpack(bytes(data))
    assert caught.value.field == "crc"


def test_metadata_that_reaches_beyond_the_body_is_refused() -> None:
    data = bytearray(pack_message(Message("TRANSFORM", "Probe", b"", version=2, metadata={"key": "value"})))
    body = data[HEADER_BYTES:]
    body[14:16] = (200).to_bytes(2, "big")  # the size of the key
    header = Header(2, "TRANSFORM", "Probe", 0, len(body), crc64.ecma_182(body))
    with pytest.raises(IgtlMessageInvalid, match="metadata"):
        unpack_message(header, bytes(body))


def test_names_are_cut_between_characters() -> None:
    assert pack_text("Sonde für Leber, rechts", 20) == "Sonde für Leber, re".encode()
    assert pack_text("ü" * 11, 20) == ("ü" * 10).encode()
    assert pack_text("ü" * 11, 19) == ("ü" * 9).encode()
