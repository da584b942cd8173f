"""Frames whose pixels stay in the bytes that came."""

import numpy as np
import pytest
from google.protobuf.message import DecodeError

from ultragray_client.messages import received_frame
from ultragray_proto.v1 import rendering_pb2

PIXELS = np.random.default_rng(0).integers(0, 255, (300, 400), dtype=np.uint8)
FACTS = {"scene": "demo", "sequence": 300, "dropped": 2**31, "encoding": "ENCODING_UINT8", "outputs": ["OUTPUT_BMODE"]}


def bytes_of(**fields):
    return rendering_pb2.Frame(**fields).SerializeToString()


@pytest.mark.parametrize("place", [0, 1, 2], ids=["first", "in between", "last"])
def test_pixels_are_not_copied_wherever_they_stand(place):
    timings = {"queue_ms": 0.5, "render_ms": 2.0, "encode_ms": 0.25}
    pieces = [bytes_of(**FACTS), bytes_of(height=300, width=400, timings=timings)]
    pieces.insert(place, bytes_of(data=PIXELS.tobytes()))
    raw = b"".join(pieces)
    received, plain = received_frame(raw), rendering_pb2.Frame.FromString(raw)
    pixels = np.frombuffer(received.data, np.uint8)
    np.testing.assert_array_equal(pixels, PIXELS.ravel())
    assert np.shares_memory(pixels, np.frombuffer(raw, np.uint8))
    for name in (*FACTS, "height", "timings"):
        assert getattr(received, name) == getattr(plain, name)
    assert (received.HasField("error"), received.HasField("timings")) == (False, True)


def test_small_frames_and_those_without_pixels_are_messages():
    for fields in ({"data": b"small"}, {"scene": "x" * 100_000}):
        assert received_frame(bytes_of(**fields)) == rendering_pb2.Frame(**fields)


@pytest.mark.parametrize("damaged", [b"\xff" * 100_000, b"\x0b" * 100_000, bytes_of(data=PIXELS.tobytes())[:-1]])
def test_damaged_bytes_are_refused_as_protobuf_refuses_them(damaged):
    with pytest.raises(DecodeError):
        received_frame(damaged)
