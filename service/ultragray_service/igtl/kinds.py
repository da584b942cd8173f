"""The types of messages that the server understands."""

from __future__ import annotations

from collections.abc import Mapping

POSE_TYPES = ("TRANSFORM", "POSITION", "TDATA", "QTDATA")
COMMAND_TYPES = ("COMMAND", "STRING")

KINDS: Mapping[str, str] = {  # by what stands behind GET_, STT_ and STP_: a type has at most 12 letters
    "IMAGE": "IMAGE",
    "TRANSFOR": "TRANSFORM",
    "TRANS": "TRANSFORM",  # in older documents of the protocol
    "POSITION": "POSITION",
    "TDATA": "TDATA",
    "QTDATA": "QTDATA",
}

_PREFIXES = ("GET_", "STT_", "STP_")
CAPABILITY = (
    *POSE_TYPES,
    *COMMAND_TYPES,
    "GET_CAPABIL",
    "GET_STATUS",
    *(f"{prefix}{suffix}" for suffix in KINDS if suffix != "TRANS" for prefix in _PREFIXES),
)
UNDERSTOOD = frozenset({*CAPABILITY, *(f"{prefix}TRANS" for prefix in _PREFIXES)})

HEARD = ("STATUS", "CAPABILITY", "RTS_")  # beginnings of types that are answers themselves
