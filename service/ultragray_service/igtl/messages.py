"""The framing of OpenIGTLink messages: header, extended header, metadata, CRC-64. All numbers are big-endian."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from ultragray_service.errors import IgtlMessageInvalid

_POLYNOMIAL = 0x42F0E1EBA9EA3693  # of degree 64, whose own coefficient is not written
_LOW_64 = (1 << 64) - 1
_WORD_BYTES = 8
_FOLD_ABOVE_WORDS = 192  # shorter messages are done byte by byte
_TRIES = 16  # one part in so many of the exponents that would do is searched for the lightest


def crc64(data: bytes | bytearray | memoryview) -> int:
    """The checksum of `data`.

    The data is a polynomial over GF(2). P(x) divides P(x⁶⁴) = P(x)⁶⁴, so words of 64 bits may be reduced modulo P(y),
    y = x⁶⁴, by XORs of whole words: yᵏ mod P(y) has at most 64 terms, so the upper words, shifted and added that
    often, replace themselves, and half of the data is gone. What remains is divided byte by byte.
    """
    if len(data) > _WORD_BYTES * _FOLD_ABOVE_WORDS:
        data = _folded(data)
    table = _table()
    remainder = 0
    for byte in data:
        remainder = (remainder << 8 & _LOW_64) ^ table[remainder >> 56 ^ byte]
    return remainder


def _folded(data: bytes | bytearray | memoryview) -> bytes:
    """A short message with the same checksum."""
    count = -(-len(data) // _WORD_BYTES)
    words = np.zeros(count, np.uint64)
    words.view(np.uint8)[count * _WORD_BYTES - len(data) :] = np.frombuffer(data, np.uint8)  # leading zeros are free
    while len(words) > _FOLD_ABOVE_WORDS:
        exponent, terms = _fold(len(words))
        upper, lower = words[:-exponent], words[-exponent:]
        for term in terms:
            end = exponent - term
            part = lower[end - len(upper) : end]
            np.bitwise_xor(part, upper, out=part)
        words = lower
    return words.tobytes()


@cache
def _table() -> list[int]:
    """The remainders of one byte followed by eight zero bytes."""
    remainders = []
    for byte in range(256):
        remainder = byte << 56
        for _ in range(8):
            remainder = _times_x(remainder)
        remainders.append(remainder)
    return remainders


def _fold(count: int) -> tuple[int, tuple[int, ...]]:
    """An exponent k by which `count` words may be folded, and the terms of yᵏ mod P(y); few terms, where possible."""
    least = (count + 64) // 2  # the shifted upper words must fit into the lower ones
    step = max(1, (1 << least.bit_length()) // 16)
    least = min(-(-least // step) * step, count - 1)
    return _lightest(least, min(least + least // _TRIES, count - 1))


@cache
def _lightest(first: int, last: int) -> tuple[int, tuple[int, ...]]:
    remainder = _power(first)
    best, lightest = first, remainder
    for exponent in range(first + 1, last + 1):
        remainder = _times_x(remainder)
        if remainder.bit_count() < lightest.bit_count():
            best, lightest = exponent, remainder
    return best, tuple(term for term in range(64) if lightest >> term & 1)


def _power(exponent: int) -> int:
    """xᵏ mod P(x)."""
    remainder = 1
    for bit in bin(exponent)[2:]:
        squared = 0
        for position in range(63, -1, -1):
            squared = _times_x(squared)
            if remainder >> position & 1:
                squared ^= remainder
        remainder = _times_x(squared) if bit == "1" else squared
    return remainder


def _times_x(remainder: int) -> int:
    return (remainder << 1 & _LOW_64) ^ (_POLYNOMIAL if remainder >> 63 else 0)


# The framing of OpenIGTLink messages: header, extended header, metadata. All numbers are big-endian.


HEADER_BYTES = 58
DEVICE_NAME_BYTES = 20

_HEADER = struct.Struct(">H12s20sQQQ")
_EXTENDED_HEADER = struct.Struct(">HHII")
_METADATA_COUNT = struct.Struct(">H")
_METADATA_ENTRY = struct.Struct(">HHI")
_UTF8 = 106  # the number of the character set at IANA
_VERSIONS = (1, 2)


@dataclass(frozen=True)
class Header:
    """The first 58 bytes of a message. `timestamp` counts 2⁻³² s since 1970; 0: none."""

    version: int
    type_name: str
    device_name: str
    timestamp: int
    body_bytes: int
    crc: int


@dataclass(frozen=True)
class Message:
    """A message whose frame has been taken off. Messages of version 1 have no `message_id` and no `metadata`."""

    type_name: str
    device_name: str
    content: bytes = b""
    timestamp: int = 0
    version: int = 1
    message_id: int = 0
    metadata: Mapping[str, str] = field(default_factory=dict)


def unpack_header(data: bytes) -> Header:
    """The header in 58 bytes. Raises IgtlMessageInvalid where they cannot be one."""
    version, type_name, device_name, timestamp, body_bytes, crc = _HEADER.unpack(data)
    name = unpack_text(type_name)
    if version not in _VERSIONS or not name or not name.isascii() or not name.isprintable():
        raise IgtlMessageInvalid(
            f"a header must have version 1 or 2 and a type name, got version {version} and {type_name!r}",
            field="header",
        )
    return Header(version, name, unpack_text(device_name), timestamp, body_bytes, crc)


def unpack_message(header: Header, body: bytes) -> Message:
    """The message of a header and its body. Raises IgtlMessageInvalid; its field is `crc` or `body`."""
    found = crc64(body)
    if found != header.crc:
        raise IgtlMessageInvalid(
            f"{header.type_name}: the CRC-64 of the body must be {header.crc:016x} as in the header, got {found:016x}",
            field="crc",
        )
    if header.version == 1:
        return Message(header.type_name, header.device_name, body, header.timestamp)
    try:
        extended_bytes, index_bytes, metadata_bytes, message_id = _EXTENDED_HEADER.unpack_from(body)
        end = len(body) - index_bytes - metadata_bytes
        if not _EXTENDED_HEADER.size <= extended_bytes <= end:
            raise ValueError
        metadata = _unpack_metadata(body[end : end + index_bytes], body[end + index_bytes :])
    except (struct.error, ValueError):
        raise IgtlMessageInvalid(
            f"{header.type_name}: a body of version 2 must hold an extended header and the metadata that it counts, "
            f"got {len(body)} bytes",
            field="body",
        ) from None
    content = body[extended_bytes:end]
    return Message(
        header.type_name, header.device_name, content, header.timestamp, header.version, message_id, metadata
    )


def _unpack_metadata(index: bytes, values: bytes) -> dict[str, str]:
    """Raises struct.error and ValueError."""
    metadata: dict[str, str] = {}
    if not index:
        return metadata
    (count,) = _METADATA_COUNT.unpack_from(index)
    start = 0
    for entry in range(count):
        key_bytes, _, value_bytes = _METADATA_ENTRY.unpack_from(index, _METADATA_COUNT.size + entry * 8)
        middle, end = start + key_bytes, start + key_bytes + value_bytes
        if end > len(values):
            raise ValueError
        metadata[values[start:middle].decode("utf-8", "replace")] = values[middle:end].decode("utf-8", "replace")
        start = end
    return metadata


def pack_message(message: Message) -> bytes:
    """The bytes of a message, its CRC included."""
    extended, index, values = b"", b"", b""
    if message.version > 1:
        index = _METADATA_COUNT.pack(len(message.metadata))
        for key, value in message.metadata.items():
            encoded_key, encoded_value = key.encode(), value.encode()
            index += _METADATA_ENTRY.pack(len(encoded_key), _UTF8, len(encoded_value))
            values += encoded_key + encoded_value
        extended = _EXTENDED_HEADER.pack(_EXTENDED_HEADER.size, len(index), len(values), message.message_id)
    body = b"".join((extended, message.content, index, values))
    header = _HEADER.pack(
        message.version,
        message.type_name.encode(),
        pack_text(message.device_name, DEVICE_NAME_BYTES),
        message.timestamp,
        len(body),
        crc64(body),
    )
    return header + body


def unpack_text(data: bytes) -> str:
    """The text of a field of fixed size, which NUL or blanks fill up."""
    return data.partition(b"\0")[0].decode("utf-8", "replace").rstrip()


def pack_text(text: str, limit_bytes: int) -> bytes:
    """`text` as UTF-8, cut at `limit_bytes`, between characters."""
    return text.encode()[:limit_bytes].decode("utf-8", "ignore").encode()
