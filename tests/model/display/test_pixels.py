"""Pixels as bytes."""

import cv2
import numpy as np

from ultragray.rendering.pixels import encoded_image, in_type, to_uint8
from ultragray.rendering.settings import Encoding


def test_uint8_saturates_and_rounds():
    frame = np.array([[[0.0, 0.4 / 255, 0.6 / 255, 127.4 / 255, 1.0, 2.0]]], np.float32)
    before = frame.copy()
    np.testing.assert_array_equal(to_uint8(frame), [[[0, 0, 1, 127, 255, 255]]])
    np.testing.assert_array_equal(frame, before)


def test_pixels_are_little_endian_and_contiguous():
    frames = np.arange(12, dtype=np.float32).reshape(2, 2, 3)[:, :, ::2]
    assert in_type(frames, Encoding.FLOAT32.pixel_type).data.cast("B")[4:8].tobytes() == np.float32(2).tobytes()
    assert in_type(frames, Encoding.UINT8.pixel_type).tolist() == [[[0, 255], [255, 255]], [[255, 255], [255, 255]]]


def test_bytes_are_taken_as_they_are():
    """A GPU has rounded them already, or they are labels."""
    frame = np.array([[0, 1], [254, 255]], np.uint8)
    assert in_type(frame[None], Encoding.UINT8.pixel_type).tolist() == [frame.tolist()]
    floats = in_type(frame[None], Encoding.FLOAT32.pixel_type)
    assert (floats.dtype.str, floats.tolist()) == ("<f4", [frame.tolist()])
    assert cv2.imdecode(encoded_image(frame, Encoding.PNG), cv2.IMREAD_UNCHANGED).tolist() == frame.tolist()


def test_one_by_one_images():
    frame = np.full((1, 1), 0.5, np.float32)
    assert encoded_image(frame, Encoding.PNG).tobytes().startswith(b"\x89PNG")
    assert encoded_image(frame, Encoding.JPEG).tobytes().startswith(b"\xff\xd8")
