"""Messages over the WebSocket: each gets a frame or a refusal, and the stream goes on, or the connection is closed by
the rules of the protocol.
"""

import base64
import json
import os
import socket
import struct
from itertools import cycle

import pytest
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from .fuzzed import UNEXPECTED_REASONS
from .mutations import as_json, mutated_bytes, mutated_json

pytestmark = pytest.mark.long

GROUP = 10  # messages on one connection: the first decide about the mode, and settings last
LAST = 2**40  # the sequence of the message that must be answered after them
TIMEOUT_S = 60.0
POSE = {"position_mm": {"x": 1.0, "y": 0.0, "z": 0.0}, "quaternion": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}}
MATRIX = {"matrix": [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]}
SETTINGS = {
    "height": 16,
    "width": 12,
    "outputs": ["bmode"],
    "encoding": "uint8",
    "probe": {"kind": "linear", "width_mm": 40.0, "near_mm": 0.0, "far_mm": 40.0},
    "display": {"gain_db": 3.0, "dynamic_range_db": 50.0, "tgc_db": [0.0, 3.0], "depth_mm": 30.0, "flip": True},
    "slice_thickness_mm": 2.0,
    "min_confidence": 0.0,
    "below_min_confidence": "mask",
}
MESSAGES = (
    {"sequence": 1, "pose": POSE},
    {"sequence": 2, "pose": MATRIX, "settings": SETTINGS},
    {"sequence": 3, "settings": {"height": 20, "encoding": "png"}},
    {"sequence": 4, "pose": POSE, "timeout_ms": 1000.0, "client_time_ms": 12.5},
    {"sequence": 5, "pose": POSE, "settings": {"display": {"pixel_mm": 1.0, "edge": 1.0}}},
)
_INTERNAL_ERROR = 1011


def messages():
    """Text or bytes, as a client may send them."""
    text = mutated_json(MESSAGES).map(lambda document: as_json(document).decode())
    raw = mutated_bytes([json.dumps(message).encode() for message in MESSAGES])
    as_text = raw.map(lambda data: data.decode("utf-8", "replace"))
    first = st.sampled_from(["latest", "ordered"]).map(lambda mode: json.dumps({"mode": mode, "pose": POSE}))
    return st.one_of(text, text, text, as_text, raw, first)


def test_messages(door, well):
    def attempt(group):
        well.require_alive()
        host, port = well.address
        address = f"ws://{host}:{port}/v1/scenes/demo/stream"
        closed = None
        with connect(address, compression=None, max_size=None, close_timeout=5, open_timeout=TIMEOUT_S) as stream:
            try:
                for message in group:
                    stream.send(message)
                stream.send(json.dumps({"sequence": LAST, "settings": {}, "pose": POSE}))
                wait_for_the_last(stream)
            except ConnectionClosed as error:
                closed = error
        assert closed is None or (closed.rcvd is not None and closed.rcvd.code != _INTERNAL_ERROR), closed

    door("websocket").enter(st.lists(messages(), min_size=GROUP, max_size=GROUP), attempt, group=GROUP)


def wait_for_the_last(stream):
    while True:
        answer = stream.recv(timeout=TIMEOUT_S)
        if isinstance(answer, bytes):
            header = json.loads(answer[4 : 4 + int.from_bytes(answer[:4], "little")])
        else:
            header = json.loads(answer)
            assert header["error"]["reason"] not in UNEXPECTED_REASONS, header
        if header["sequence"] == LAST:
            return


def test_paths_of_streams(door, well):
    def attempt(scene):
        well.require_alive()
        host, port = well.address
        status = 101
        try:
            with connect(f"ws://{host}:{port}/v1/scenes/{scene}/stream", compression=None, open_timeout=TIMEOUT_S):
                pass
        except InvalidStatus as refused:
            status = refused.response.status_code
        assert status < 500

    names = mutated_bytes([b"demo", b"control", b"%2e%2e", b"probeless"], alphabet=b"demo%2e0fA._-~!$&'()*+,;=:@")
    door("websocket paths").enter(names.map(lambda name: name.decode("ascii", "ignore")).filter(_plain), attempt)


def _plain(name):
    """Whether it can stand in a URL at all."""
    return all(33 <= ord(character) < 127 and character not in '/?#[]\\<>"{}|^`' for character in name)


# Control frames between the fragments of messages: what RFC 6455 asks of the server is worked out here once more, and
# compared with what it does.

TEXT, CLOSE, PING, PONG = 1, 8, 9, 10
MOST_EMPTY = 50  # so that no flood is closed
_CODES = (1000, 1001, 1003, 1007, 1011, 3000, 4999, 999, 1004, 1005, 1006, 1015, 2000, 5000, 0)


def frame_bytes(opcode, payload=b"", *, fin=True, reserved=0, is_masked=True):
    head = bytes([fin << 7 | reserved << 4 | opcode])
    length, mask = len(payload), os.urandom(4)
    head += bytes([is_masked << 7 | (length if length < 126 else 126)]) + (
        struct.pack("!H", length) if length > 125 else b""
    )
    return head + (mask + bytes(a ^ b for a, b in zip(payload, cycle(mask), strict=False)) if is_masked else payload)


def control_frames():
    """Pieces of a conversation: (opcode, payload, what is wrong with the frame)."""
    payloads = st.binary(max_size=125)
    closes = st.builds(
        lambda code, reason: struct.pack("!H", code) + reason, st.sampled_from(_CODES), st.binary(max_size=9)
    )
    good = st.tuples(st.sampled_from([PING, PONG]), payloads, st.just({}))
    wrong = st.sampled_from([{"fin": False}, {"reserved": 1}, {"reserved": 4}, {"is_masked": False}])
    piece = st.tuples(st.just(TEXT), st.integers(1, 40).map(bytes), st.just({}))
    return st.one_of(
        *(good, good, good, piece, piece, piece),
        st.tuples(st.sampled_from([PING, PONG, CLOSE]), payloads, wrong),
        st.tuples(st.sampled_from([PING, PONG]), st.binary(min_size=126, max_size=300), st.just({})),
        st.tuples(st.sampled_from([3, 5, 7, 11, 15]), payloads, st.just({})),
        st.tuples(st.just(CLOSE), st.one_of(closes, st.binary(max_size=1)), st.just({})),
    )


def code_expected(opcode, payload, wrong):
    """The code that the server closes with after a control frame; None: it goes on."""
    if wrong or opcode not in (CLOSE, PING, PONG) or len(payload) > 125:
        return 1002
    if opcode != CLOSE:
        return None
    if not payload:
        return 1000
    if len(payload) < 2:
        return 1002
    (code,) = struct.unpack("!H", payload[:2])
    try:
        payload[2:].decode()
    except UnicodeDecodeError:
        return 1007
    return code if code in (1000, 1001, 1002, 1003, *range(1007, 1015)) or 3000 <= code < 5000 else 1002


def conversation(pieces):
    """Bytes to send, the payloads of pongs, the sequences that are answered and the code of the close: None, if the
    connection stays."""
    messages = [json.dumps({"mode": "ordered", "sequence": 0, "pose": POSE}).encode()]
    sent, pongs, begun = frame_bytes(TEXT, messages[0]), [], b""
    for opcode, payload, wrong in pieces:
        if opcode == TEXT:  # the length of the payload tells how much of a message is sent
            left = begun or json.dumps({"sequence": len(messages), "pose": POSE}).encode()
            part, rest = left[: len(payload) * 8], left[len(payload) * 8 :]
            sent += frame_bytes(0 if begun else TEXT, part, fin=not rest)
            messages += [] if rest else [left]
            begun = rest
            continue
        sent += frame_bytes(opcode, payload, **wrong)
        code = code_expected(opcode, payload, wrong)
        if opcode == CLOSE and begun and code != 1007:  # data may not follow a close: the message stays incomplete
            code = 1002
        if code is not None:
            return sent, pongs, len(messages), code
        pongs += [payload] if opcode == PING else []
    if begun:
        sent, messages = sent + frame_bytes(0, begun), [*messages, begun]
    return sent, pongs, len(messages), None


class RawStream:
    """A WebSocket by hand: its frames are neither checked nor answered."""

    def __init__(self, address):
        self._socket = socket.create_connection(address, TIMEOUT_S)
        key = base64.b64encode(os.urandom(16)).decode()
        head = [
            "GET /v1/scenes/demo/stream HTTP/1.1",
            f"Host: {address[0]}",
            "Upgrade: websocket",
            "Connection: Upgrade",
        ]
        head += ["Sec-WebSocket-Version: 13", f"Sec-WebSocket-Key: {key}", "", ""]
        self._socket.sendall("\r\n".join(head).encode())
        self._file = self._socket.makefile("rb")
        assert b" 101 " in self._file.readline()
        while self._file.readline() != b"\r\n":
            pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._file.close()
        self._socket.close()

    def send(self, data):
        self._socket.sendall(data)

    def frames(self):
        """(opcode, payload) of what the server sends, until it ends."""
        while len(head := self._file.read(2)) == 2:
            length = head[1] & 127
            if length > 125:
                length = int.from_bytes(self._file.read(2 if length == 126 else 8), "big")
            yield head[0] & 15, self._file.read(length)


def test_control_frames(door, well):
    def attempt(pieces):
        well.require_alive()
        sent, pongs, answered, code = conversation(pieces)
        found, sequences, closed = [], [], None
        with RawStream(well.address) as stream:
            stream.send(sent)
            for opcode, payload in stream.frames():
                if opcode == PONG:
                    found.append(payload)
                elif opcode == CLOSE:
                    closed = struct.unpack("!H", payload[:2])[0] if payload else 1000
                    break
                elif opcode != PING:
                    header = payload[4 : 4 + int.from_bytes(payload[:4], "little")] if opcode == 2 else payload
                    sequences.append(json.loads(header)["sequence"])
                if code is None and len(found) == len(pongs) and len(sequences) == answered:
                    break
        assert closed == code
        assert found == pongs
        assert sequences == list(range(len(sequences)))  # of those before a close, as many as were done by then
        assert code is not None or len(sequences) == answered

    door("control frames").enter(st.lists(control_frames(), max_size=MOST_EMPTY), attempt)
