"""Memory that the benchmark's client shares with the service."""

from __future__ import annotations

import mmap
import os
import secrets

from ultragray_proto.v1 import rendering_pb2
from ultragray_service.rpc.shared_memory import FOLDER, FREE, HEADER_BYTES, TOKEN_BYTES

_SLOT_BYTES = 4 * 2**20


class SharedFile:
    """A client's side of shared memory, as rendering.proto has it; the service removes the name of the file."""

    def __init__(self, slots: int) -> None:
        self.message = rendering_pb2.SharedMemory(
            name=f"ultragray-{secrets.token_hex(16)}",
            token=secrets.token_bytes(TOKEN_BYTES),
            slots=slots,
            slot_bytes=_SLOT_BYTES,
        )
        size = HEADER_BYTES + slots * _SLOT_BYTES
        descriptor = os.open(f"{FOLDER}/{self.message.name}", os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        os.ftruncate(descriptor, size)
        os.pwrite(descriptor, self.message.token + FREE * slots, 0)
        self._map = mmap.mmap(descriptor, size)
        os.close(descriptor)

    def free(self, data: rendering_pb2.SharedData) -> None:
        """The client has looked at the pixels where they lie."""
        self._map[TOKEN_BYTES + data.slot : TOKEN_BYTES + data.slot + 1] = FREE
