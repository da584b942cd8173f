"""Messages over the WebSocket: each gets a frame or a refusal, and the stream goes on, or the connection is closed by
the rules of the protocol.
"""

import json

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
