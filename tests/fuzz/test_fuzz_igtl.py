"""OpenIGTLink: well-formed messages with contents of all kinds, and bytes that are no messages."""

import contextlib
import socket
import struct

import numpy as np
import pytest
from hypothesis import strategies as st

from ultragray_service.igtl.commands import Command, pack_command
from ultragray_service.igtl.contents import Instrument, pack_instruments, pack_position, pack_transform
from ultragray_service.igtl.messages import HEADER_BYTES, Message, pack_message, unpack_header

from .mutations import REALS, TEXTS, mutated_bytes

pytestmark = pytest.mark.long

GROUP = 20  # messages on one connection
TIMEOUT_S = 60.0
LAST = 2**33 + 77  # the time stamp of the question that must be answered after them
TOOL = Instrument("demo", np.eye(4))
COMMAND = '<Command Name="SetUsParameter"><Parameter Name="DepthMm" Value="20"/></Command>'
VALID = (
    ("TRANSFORM", pack_transform(np.eye(4))),
    ("POSITION", pack_position(np.eye(4))),
    ("TDATA", pack_instruments("TDATA", [TOOL, TOOL])),
    ("QTDATA", pack_instruments("QTDATA", [TOOL])),
    ("GET_STATUS", b""),
    ("GET_CAPABIL", b""),
    ("GET_IMAGE", b""),
    ("STT_IMAGE", b""),
    ("STP_IMAGE", b""),
    ("STT_QTDATA", struct.pack(">I", 20) + bytes(20)),
    ("STATUS", bytes(30)),
    ("STRING", b"\0\3\0\5hello"),
    ("COMMAND", pack_command(Command(1, "SetUsParameter", COMMAND))),
    ("IMAGE", bytes(72)),
)
DEVICES = (
    "demo",
    "CMD_1",
    "second",
    "probeless",
    "absent",
    "",
    "x" * 20,
    "ä" * 10,
    *(text for text in TEXTS if text.isascii()),
)


def messages():
    """A whole message, whose header and checksum are right."""
    content = {name: mutated_bytes([data]) if data else st.binary(max_size=60) for name, data in VALID}
    matrix = st.lists(st.one_of(st.sampled_from(REALS), st.floats(-2, 2)), min_size=12, max_size=12)
    numbers = matrix.map(lambda values: np.array(values, np.float64).astype(">f4").tobytes())

    def of(name):
        contents = [st.just(dict(VALID)[name]), content[name]]
        contents += [numbers] if name == "TRANSFORM" else []
        return st.builds(
            Message,
            type_name=st.just(name) if name != "STRING" else st.text("ABC_TRANSFORM", min_size=1, max_size=12),
            device_name=st.sampled_from(DEVICES),
            content=st.one_of(contents),
            timestamp=st.one_of(st.just(0), st.integers(0, 2**64 - 1)),
            version=st.sampled_from([1, 1, 2]),
            message_id=st.just(0),
            metadata=st.just({}),
        )

    plain = st.sampled_from([name for name, _ in VALID]).flatmap(of)
    with_metadata = st.builds(
        lambda message, metadata, number: Message(
            **{**vars(message), "version": 2, "message_id": number, "metadata": metadata}
        ),
        plain,
        st.dictionaries(st.text(max_size=9), st.text(max_size=20), max_size=3),
        st.integers(0, 2**32 - 1),
    )
    return st.one_of(plain, plain, with_metadata).map(pack_message)


def talk(address, data):
    """Sends, asks for the state, and waits for its answer. Raises ConnectionResetError where none comes."""
    with socket.create_connection(address, timeout=TIMEOUT_S) as peer, contextlib.suppress(ConnectionError):
        peer.sendall(data + pack_message(Message("GET_STATUS", "", timestamp=LAST)))
        with peer.makefile("rb") as answers:
            while len(header := answers.read(HEADER_BYTES)) == HEADER_BYTES:
                told = unpack_header(header)
                answers.read(told.body_bytes)
                if told.type_name == "STATUS" and told.timestamp == LAST:
                    return
    raise ConnectionResetError


def test_messages(door, well):
    def attempt(group):
        well.require_alive()
        talk(well.igtl(), b"".join(group))

    door("igtl messages").enter(st.lists(messages(), min_size=GROUP, max_size=GROUP), attempt, group=GROUP)


def test_bytes(door, well):
    whole = [pack_message(Message(name, "demo", data, version=version)) for name, data in VALID for version in (1, 2)]

    def attempt(data):
        well.require_alive()
        with socket.create_connection(well.igtl(), timeout=TIMEOUT_S) as peer, contextlib.suppress(ConnectionError):
            peer.sendall(data)
            peer.shutdown(socket.SHUT_WR)
            while peer.recv(65536):
                pass

    door("igtl bytes").enter(mutated_bytes(whole), attempt)
