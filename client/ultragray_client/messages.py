"""Messages from what callers fill in, and frames from their bytes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any, TypeVar

from ultragray_proto.codec import MessageInvalid, from_message, to_message
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
_NUMBERS = {name: field.number for name, field in rendering_pb2.Frame.DESCRIPTOR.fields_by_name.items()}
_FIXED_BYTES = {1: 8, 5: 4}  # by wire type (protobuf.dev/programming-guides/encoding)
_VARINT, _LENGTH_DELIMITED = 0, 2
_MOST_OF_A_VARINT = 10  # bytes
_MOST_OF_HEADS = 64


class ReceivedFrame:
    """A rendering_pb2.Frame, of which the fields that begin it are read once where they come again with each frame.

    Its pixels stay in the bytes that came where they are many. protobuf copies them twice. The allocator gives such
    blocks back to the system at once, and gets them anew, page by page: that took most of a client's time for three
    float32 outputs of 512x512.
    """

    def __init__(self, message: rendering_pb2.Frame, same: Mapping[str, Any], data: bytes | memoryview) -> None:
        self.message = message  # what is left
        self.same = same  # attributes of a frame that it begins with; none where it begins with something else
        self.data = data  # pixels


class FrameHeads:
    """The attributes that frames begin with, by their bytes: a service sends what does not change first."""

    def __init__(self, cls: type) -> None:
        """`cls`: of the attributes, all of which must be there where they have no default."""
        self._cls = cls
        self._numbers = {_NUMBERS[one.name] for one in fields(cls)}
        self._known: dict[bytes, Mapping[str, Any]] = {}
        self._newest = 0  # bytes of the head that came last

    def read(self, raw: bytes) -> ReceivedFrame:
        """The frame of its bytes. Raises google.protobuf.message.DecodeError."""
        size = self._newest
        same = self._known.get(raw[:size])
        if same is None or self._goes_on(raw, size):
            size, same = self._learn(raw)
        if len(raw) >= _LARGE_BYTES:
            for number, begin, content, end in _fields(raw, size):
                if number == _NUMBERS["data"]:
                    rest = rendering_pb2.Frame.FromString(raw[size:begin] + raw[end:])
                    return ReceivedFrame(rest, same, memoryview(raw)[content:end])
        message = rendering_pb2.Frame.FromString(raw[size:])
        return ReceivedFrame(message, same, message.data)

    def _goes_on(self, raw: bytes, size: int) -> bool:
        """Whether a head has more fields than those before `size`."""
        return size < len(raw) and _varint(raw, size)[0] >> 3 in self._numbers

    def _learn(self, raw: bytes) -> tuple[int, Mapping[str, Any]]:
        size = 0
        for number, _, _, end in _fields(raw):
            if number not in self._numbers:
                break
            size = end
        head = raw[:size]
        if (same := self._known.get(head)) is None:
            try:
                same = vars(from_message(rendering_pb2.Frame.FromString(head), self._cls))
            except MessageInvalid:  # it does not have all of them
                return 0, {}
            if len(self._known) >= _MOST_OF_HEADS:
                self._known.clear()
            self._known[head] = same
        self._newest = size
        return size, same


def _fields(raw: bytes, at: int = 0) -> Iterator[tuple[int, int, int, int]]:
    """The number of each field, and where it, its content and what follows begin; up to what is no field."""
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
