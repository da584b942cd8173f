"""What the service and a worker process share: a channel of messages, a board of numbers, and the memory that frames
come back through.
"""

from __future__ import annotations

import mmap
import os
import pickle
import socket
from collections.abc import Sequence
from typing import Any

import numpy as np

from ultragray.rendering.limits import Flag

MAX_MESSAGE_BYTES = 64 * 1024  # below Linux's default send buffer, so that sending never blocks
MAX_DESCRIPTORS = 128  # Linux passes at most 253 at once


class Channel:
    """One end of a pair of sequenced-packet sockets: whole pickled messages in order, then an end of file.

    Both ends belong to processes of one service, so that unpickling what arrives is safe.
    """

    def __init__(self, end: socket.socket) -> None:
        self._socket = end

    @classmethod
    def pair(cls) -> tuple[Channel, Channel]:
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        return cls(near), cls(far)

    @classmethod
    def from_descriptor(cls, descriptor: int) -> Channel:
        """Takes over an open descriptor of a channel's end."""
        return cls(socket.socket(fileno=descriptor))

    def fileno(self) -> int:
        return self._socket.fileno()

    def set_blocking(self, blocking: bool) -> None:
        self._socket.setblocking(blocking)

    def send(self, message: object, descriptors: Sequence[int] = ()) -> None:
        """Sends a message; the peer gets its own copies of the descriptors. Raises OSError when it is gone."""
        data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
        if len(data) > MAX_MESSAGE_BYTES:
            raise ValueError(f"a message must have at most {MAX_MESSAGE_BYTES} bytes, got {len(data)}")
        if descriptors:
            socket.send_fds(self._socket, [data], list(descriptors))
        else:
            self._socket.send(data)

    def receive(self) -> tuple[Any, list[int]]:
        """The next message and its descriptors. Raises EOFError or ConnectionError when the peer is gone."""
        data, descriptors, _, _ = socket.recv_fds(self._socket, MAX_MESSAGE_BYTES, MAX_DESCRIPTORS)
        if not data:
            raise EOFError
        return pickle.loads(data), descriptors

    def hang_up(self) -> None:
        """Tells the peer to exit, while its own end of file can still be seen here."""
        self._socket.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        self._socket.close()


# A little memory that the service shares with one of its worker processes: written and read without a message.


_TAKEN, _GIVEN_UP, _FIELDS = range(3)


class Board:
    """Numbers of a worker's tasks, which both sides count from 1: the last one taken up, the last to be given up."""

    def __init__(self, descriptor: int) -> None:
        self._memory = mmap.mmap(descriptor, _FIELDS * np.dtype(np.int64).itemsize)
        numbers = np.frombuffer(self._memory, np.int64)
        self.taken: Flag = numbers[_TAKEN : _TAKEN + 1]  # the worker writes it
        self.given_up: Flag = numbers[_GIVEN_UP : _GIVEN_UP + 1]  # the service writes it; kernels look at it

    def close(self) -> None:
        """Gives the memory back; nothing is written or read any more."""
        del self.taken, self.given_up
        self._memory.close()

    @staticmethod
    def new_memory() -> int:
        descriptor = os.memfd_create("ultragray-board")
        os.ftruncate(descriptor, _FIELDS * np.dtype(np.int64).itemsize)
        return descriptor


# The memory that frames come back through: anonymous files, passed between processes as descriptors.
#
# They have no name, so that nothing is left behind however a process ends.


MAX_SPARES = 32
MAX_SPARE_BYTES = 16 * 2**20


class MemoryPool:
    """Anonymous files, kept for reuse: a frame is written into a used one five times as fast."""

    def __init__(self) -> None:
        self._spares: list[int] = []
        self._is_closed = False

    def acquire(self) -> int:
        """The descriptor of a file that nobody else uses. It may hold an earlier reply."""
        return self._spares.pop() if self._spares else os.memfd_create("ultragray-frames")

    def release(self, descriptor: int) -> None:
        """Takes back a file that no worker writes any more."""
        if not self._is_closed and len(self._spares) < MAX_SPARES and os.fstat(descriptor).st_size <= MAX_SPARE_BYTES:
            self._spares.append(descriptor)
        else:
            os.close(descriptor)

    def close(self) -> None:
        self._is_closed = True
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
