"""Messages from what callers fill in, and frames from their bytes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeVar

from ultragray_proto.codec import MessageInvalid, to_message
from ultragray_proto.v1 import rendering_pb2

from .errors import InvalidArgument, UnknownOutput

M = TypeVar("M")

_ERRORS = {"outputs": UnknownOutput}  # by the field; all others are InvalidArgument


def message_of(value: Any, cls: type[M], **others: Any) -> M:
    """The message of a dataclass; `others` are fields that it does not have. The service checks the numbers.

    Raises InvalidArgument, or a kind of it, for a word that no message has.
    """
    try:
        return to_message(value, cls, **others)
    except MessageInvalid as error:
        field = error.field.partition("[")[0]
        raise _ERRORS.get(field, InvalidArgument)(str(error), field=field) from None


_LARGE_BYTES = 2**16  # of a message: below, finding its pixels takes longer than copying them
_DATA = rendering_pb2.Frame.DESCRIPTOR.fields_by_name["data"].number
_FIXED_BYTES = {1: 8, 5: 4}  # by wire type (protobuf.dev/programming-guides/encoding)
_VARINT, _LENGTH_DELIMITED = 0, 2
_MOST_OF_A_VARINT = 10  # bytes


class LargeFrame:
    """A rendering_pb2.Frame but for its pixels, which stay in the bytes that came.

    protobuf copies them twice. The allocator gives such blocks back to the system at once, and gets them anew, page by
    page: that took most of a client's time for three float32 outputs of 512x512.
    """

    def __init__(self, message: rendering_pb2.Frame, data: memoryview) -> None:
        self._message, self.data = message, data

    def __getattr__(self, name: str) -> Any:
        return getattr(self._message, name)


def received_frame(raw: bytes) -> Any:  # rendering_pb2.Frame | LargeFrame
    """The frame of its bytes. Raises google.protobuf.message.DecodeError."""
    if len(raw) >= _LARGE_BYTES:
        for number, begin, content, end in _fields(raw):
            if number == _DATA:
                rest = rendering_pb2.Frame.FromString(raw[:begin] + raw[end:])
                return LargeFrame(rest, memoryview(raw)[content:end])
    return rendering_pb2.Frame.FromString(raw)


def _fields(raw: bytes) -> Iterator[tuple[int, int, int, int]]:
    """The number of each field, and where it, its content and what follows begin; up to what is no field."""
    at = 0
    while at < len(raw):
        begin = at
        key, at = _varint(raw, at)
        kind, content = key & 7, at
        if kind == _VARINT:
            _, at = _varint(raw, at)
        elif kind == _LENGTH_DELIMITED:
            size, content = _varint(raw, at)
            at = content + size
        elif kind in _FIXED_BYTES:
            at += _FIXED_BYTES[kind]
        else:
            return
        if at > len(raw):
            return
        yield key >> 3, begin, content, at


def _varint(raw: bytes, at: int) -> tuple[int, int]:
    """The whole number at a place, and where it ends: seven bits a byte, the lowest first, the last below 128."""
    number = shift = 0
    for end in range(at, min(at + _MOST_OF_A_VARINT, len(raw))):
        number |= (raw[end] & 0x7F) << shift
        if raw[end] < 0x80:
            return number, end + 1
        shift += 7
    return number, len(raw) + 1
