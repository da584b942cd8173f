"""Frames from the bytes that came: what they begin with is read once, many pixels stay where they are."""

import numpy as np
import pytest
from google.protobuf.message import DecodeError

from ultragray_client.frames import frame_from_message, received_frame
from ultragray_proto.v1 import rendering_pb2

PIXELS = np.random.default_rng(0).integers(0, 255, (300, 400), dtype=np.uint8)
LINEAR = {"linear": {"width_mm": 40.0, "far_mm": 50.0}}
PICTURE = {"column_unit": "mm", "column_step": 0.1, "row_step_mm": 0.1}
HEAD = {
    "scene": "demo",
    "scene_sha256": "0" * 64,
    "renderer": "ultragray/0 cpu",
    "probe": LINEAR,
    "picture": PICTURE,
    "height": 300,
    "width": 400,
    "rendered_height": 300,
    "rendered_width": 400,
    "outputs": ["OUTPUT_BMODE"],
    "encoding": "ENCODING_UINT8",
}
POSE = np.eye(4)
FACTS = {
    "sequence": 300,
    "dropped": 2**31,
    "pose": {"values": POSE.ravel().tolist()},
    "timings": {"queue_ms": 0.5, "render_ms": 2.0, "encode_ms": 0.25},
    "extrapolation": {"confidence": 0.5},
}


def bytes_of(**fields):
    return rendering_pb2.Frame(**fields).SerializeToString()


def told(frame):
    return {name: value for name, value in vars(frame).items() if name not in ("arrays", "pose")}


@pytest.mark.parametrize("place", [0, 1, 2, 3], ids=["first", "second", "third", "last"])
@pytest.mark.parametrize("begins_with", ["head", "facts"])
def test_the_frame_of_its_bytes_in_whatever_order_they_come(place, begins_with):
    pieces = [bytes_of(**HEAD), bytes_of(**FACTS), bytes_of(client_time_ns=5)]
    if begins_with == "facts":
        pieces.reverse()
    pieces.insert(place, bytes_of(data=PIXELS.tobytes()))
    raw = b"".join(pieces)
    for _ in range(2):  # the second time the head is known
        received = received_frame(raw)
        frame = frame_from_message(received, sequence=300, dropped=7)
        np.testing.assert_array_equal(frame["bmode"], PIXELS)
        assert np.shares_memory(frame["bmode"], np.frombuffer(raw, np.uint8))
        assert (frame.scene, frame.height, frame.outputs, frame.ghost) == ("demo", 300, ("bmode",), 0.0)
        assert (frame.extrapolation.confidence, frame.timings.render_ms, frame.dropped) == (0.5, 2.0, 7)
        assert bool(received.same) == (raw.startswith(pieces[0]) and pieces[0] == bytes_of(**HEAD))


def test_frames_with_another_head_are_told_apart():
    data = {"data": PIXELS.tobytes()}
    plain, longer = bytes_of(**HEAD), bytes_of(**HEAD) + bytes_of(ghost=0.5)
    other = bytes_of(**{**HEAD, "scene": "dem0"})
    for head, scene, ghost in 2 * ((plain, "demo", 0.0), (longer, "demo", 0.5), (other, "dem0", 0.0)):
        frame = frame_from_message(received_frame(head + bytes_of(**FACTS, **data)))
        assert (frame.scene, frame.ghost) == (scene, ghost)


def test_few_pixels_and_errors_are_read_as_protobuf_reads_them():
    for fields in ({"data": b"small"}, {"error": {"reason": "QUEUE_FULL"}, "sequence": 3}, {"scene": "x" * 100_000}):
        received = received_frame(bytes_of(**fields))
        assert (received.message, received.data) == (rendering_pb2.Frame(**fields), fields.get("data", b""))


@pytest.mark.parametrize("damaged", [b"\xff" * 100_000, b"\x0b" * 100_000, bytes_of(data=PIXELS.tobytes())[:-1]])
def test_damaged_bytes_are_refused_as_protobuf_refuses_them(damaged):
    with pytest.raises(DecodeError):
        received_frame(damaged)
