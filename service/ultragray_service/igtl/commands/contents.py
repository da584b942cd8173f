"""The contents of COMMAND, RTS_COMMAND and STRING: a text, of a command with its number and name. Big-endian."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from ultragray_service.errors import IgtlMessageInvalid
from ultragray_service.igtl.messages import pack_text, unpack_text

_NAME_BYTES = 128
_COMMAND = struct.Struct(f">I{_NAME_BYTES}sHI")
_STRING = struct.Struct(">HH")
_UTF8 = 106  # the number of the character set at IANA; ASCII (3) is a part of it
_MOST_STRING_BYTES = 0xFFFF


@dataclass(frozen=True)
class Command:
    """A command or its reply. `name` may be empty where `text`, which is XML, has it."""

    number: int
    name: str
    text: str


def unpack_command(content: bytes) -> Command:
    """The command of a COMMAND, the reply of an RTS_COMMAND. Raises IgtlMessageInvalid."""
    if len(content) < _COMMAND.size:
        raise IgtlMessageInvalid(f"COMMAND must hold {_COMMAND.size} bytes or more, got {len(content)}", field="body")
    number, name, _, length = _COMMAND.unpack_from(content)
    return Command(number, unpack_text(name), _text("COMMAND", content[_COMMAND.size :], length))


def pack_command(command: Command) -> bytes:
    """The content of a COMMAND or an RTS_COMMAND; the name is cut at 127 bytes."""
    text = command.text.encode()
    return _COMMAND.pack(command.number, pack_text(command.name, _NAME_BYTES - 1), _UTF8, len(text)) + text


def unpack_string(content: bytes) -> str:
    """The text of a STRING. Raises IgtlMessageInvalid."""
    if len(content) < _STRING.size:
        raise IgtlMessageInvalid(f"STRING must hold {_STRING.size} bytes or more, got {len(content)}", field="body")
    _, length = _STRING.unpack_from(content)
    return _text("STRING", content[_STRING.size :], length)


def pack_string(text: str) -> bytes:
    """The content of a STRING; the text is cut at 65,535 bytes."""
    encoded = pack_text(text, _MOST_STRING_BYTES)
    return _STRING.pack(_UTF8, len(encoded)) + encoded


def _text(type_name: str, data: bytes, length: int) -> str:
    if len(data) != length:
        raise IgtlMessageInvalid(f"{type_name}: a text of {length} bytes must follow, got {len(data)}", field="body")
    try:
        return data.decode().rstrip("\0")
    except UnicodeDecodeError:
        raise IgtlMessageInvalid(f"{type_name}: its text must be ASCII or UTF-8", field="body") from None
