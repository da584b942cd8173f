"""Messages between the service and its child processes, each with the file descriptors it is about."""

from __future__ import annotations

import pickle
import socket
from collections.abc import Sequence
from typing import Any

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
