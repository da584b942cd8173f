"""Frames of a stream through memory that is shared with a service on this host; rendering.proto has its layout."""

from __future__ import annotations

import ctypes
import mmap
import os
import secrets
import weakref
from contextlib import suppress
from pathlib import Path
from typing import Any

from ultragray_proto.v1 import rendering_pb2

from ..errors import InvalidArgument

SLOTS = 16
SLOT_BYTES = 16 * 2**20  # whose pages take memory only once a frame was written there

_FOLDER = Path("/dev/shm")
_HEADER_BYTES = 4096
_TOKEN_BYTES = 32
_FREE = 1


class SharedMemory:
    """A file that the service writes frames into.

    A slot is free again when no array refers to it any more. The service removes the name of the file when it has
    opened it; `close`, or the end of this object, removes that of a file that it did not open.
    """

    def __init__(self) -> None:
        """Raises InvalidArgument where this system has no such memory."""
        self._token = secrets.token_bytes(_TOKEN_BYTES)
        path = _FOLDER / f"ultragray-{secrets.token_hex(16)}"
        size = _HEADER_BYTES + SLOTS * SLOT_BYTES
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
            self._remove = weakref.finalize(self, _remove, path)
            try:
                os.ftruncate(descriptor, size)
                os.pwrite(descriptor, self._token + bytes([_FREE]) * SLOTS, 0)
                self._map = mmap.mmap(descriptor, size)
            finally:
                os.close(descriptor)
        except OSError as error:
            raise InvalidArgument(
                f"shared_memory cannot be had on this system: {error}", field="shared_memory"
            ) from None
        self._name = path.name
        self._process = os.getpid()
        self._lent: dict[int, weakref.ref[Any]] = {}

    def message(self) -> rendering_pb2.SharedMemory:
        """The file, as the service is told of it."""
        return rendering_pb2.SharedMemory(name=self._name, token=self._token, slots=SLOTS, slot_bytes=SLOT_BYTES)

    def taken(self, message: rendering_pb2.Frame) -> Any:
        """The pixels of a frame, a buffer whose slot is not free while anything refers to it; None: the message has
        them.
        """
        if not message.HasField("shared_data"):
            return None
        slot, size = message.shared_data.slot, message.shared_data.bytes
        pixels = (ctypes.c_ubyte * size).from_buffer(self._map, _HEADER_BYTES + slot * SLOT_BYTES)
        self._lent[slot] = weakref.ref(pixels, lambda _: self._free(slot))
        return pixels

    def skip(self, message: rendering_pb2.Frame) -> None:
        """Frees the slot of a frame that nobody will look at."""
        if message.HasField("shared_data"):
            self._free(message.shared_data.slot)

    def close(self) -> None:
        """Removes the name of the file, should it still be there; frames stay as they are."""
        self._remove()

    def _free(self, slot: int) -> None:
        if os.getpid() == self._process:  # a child by fork has its own references to what its parent still looks at
            self._map[_TOKEN_BYTES + slot] = _FREE


def _remove(path: Path) -> None:
    with suppress(OSError):
        path.unlink()
