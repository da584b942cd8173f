"""The framing of OpenIGTLink messages: header, extended header, metadata, CRC-64. All numbers are big-endian."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

from fastcrc import crc64

from ultragray_service.errors import IgtlMessageInvalid

HEADER_BYTES = 58
DEVICE_NAME_BYTES = 20

_HEADER = struct.Struct(">H12s20sQQQ")
_EXTENDED_HEADER = struct.Struct(">HHII")
_METADATA_COUNT = struct.Struct(">H")
_METADATA_ENTRY = struct.Struct(">HHI")
_UTF8 = 106  # the number of the character set at IANA
_VERSIONS = (1, 2)
TICKS_PER_S = 2**32  # of timestamps


@dataclass(frozen=True)
class Header:
    """The first 58 bytes of a message. `timestamp` counts ticks since 1970; 0: none."""

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
    crc = crc64.ecma_182(body)
    if crc != header.crc:
        raise IgtlMessageInvalid(
            f"{header.type_name}: the CRC-64 of the body must be {header.crc:016x} as in the header, got {crc:016x}",
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
        crc64.ecma_182(body),
    )
    return header + body


def unpack_text(data: bytes) -> str:
    """The text of a field of fixed size, which NUL or blanks fill up."""
    return data.partition(b"\0")[0].decode("utf-8", "replace").rstrip()


def pack_text(text: str, limit_bytes: int) -> bytes:
    """`text` as UTF-8, cut at `limit_bytes`, between characters."""
    return text.encode()[:limit_bytes].decode("utf-8", "ignore").encode()
