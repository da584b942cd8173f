"""Bytes between the service and a client that has not read them yet: a latest stream sends no old frames."""

from __future__ import annotations

import asyncio
import fcntl
import socket
import struct
import sys
from dataclasses import dataclass
from typing import cast

UNSENT_BYTES = 16 * 1024  # that the kernel may hold of a connection, beside those that are on their way


def hold_little(transport: asyncio.BaseTransport) -> None:
    """Has a transport ask to wait while it buffers anything, and the kernel take no more than it can send soon.

    The limit is one byte: at a limit of none a transport of TLS asks to wait even while it buffers nothing, and then
    says that one may go on when something comes from the client, which may be never.
    """
    cast(asyncio.WriteTransport, transport).set_write_buffer_limits(high=1)
    if (endpoint := transport.get_extra_info("socket")) is not None:
        endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)


_POLL_S = 0.004
_QUIET_S = 0.25  # a client that sends nothing tells nothing about its window
_LONGEST_S = 5.0  # for a client whose window shrank for good
_FIRST_BYTES = 256
_KEEPALIVE = {"TCP_KEEPIDLE": 1, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 100}  # s, s, probes without an answer

# <linux/sockios.h> and struct tcp_info of <linux/tcp.h>
_SIOCOUTQ = 0x5411
_LAST_DATA_RECEIVED_OFFSET = 52
_SEND_WINDOW_OFFSET = 228  # since Linux 5.4
_TCP_INFO_BYTES = 232


@dataclass(frozen=True)
class _State:
    """The connection at one time."""

    unacknowledged_bytes: int  # by the kernel of the client
    window_bytes: int  # that the kernel of the client has room for
    quiet_s: float  # since the client sent something


class Unread:
    """The messages of one connection that wait in a kernel.

    The window that a client's kernel advertises is its room for unread bytes: a message was read once the window is as
    wide as it was before the message. Linux advertises less than its room, by as much as the queue held when the last
    segment came: a whole message would fit there unseen. Hence the first bytes of a message go ahead in a segment of
    their own, which finds the queue empty and has the kernel advertise all of its room.

    A client that sends nothing, as one that subscribed, tells that it has read when its kernel acknowledges the next
    message, or a keepalive probe, which comes every second.
    """

    def __init__(self, transport: asyncio.WriteTransport) -> None:
        self._transport = transport
        self._socket: socket.socket | None = transport.get_extra_info("socket")
        self._window_bytes = 0  # the widest since it last shrank for good
        self._message_bytes = 0
        self._is_ahead = False  # a message was sent after one that may be unread
        if sys.platform == "linux" and self._socket is not None:
            for option, value in _KEEPALIVE.items():
                self._socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)

    def write(self, message: bytes) -> None:
        """Raises ConnectionResetError where the client is gone: uvloop's own error would be that of a fault."""
        if self._transport.is_closing():
            raise ConnectionResetError
        if (state := self._state()) is not None:
            self._window_bytes = max(self._window_bytes, state.window_bytes)
        self._message_bytes = len(message)
        self._transport.write(message[:_FIRST_BYTES])
        if len(message) > _FIRST_BYTES:
            self._transport.write(message[_FIRST_BYTES:])

    async def none(self) -> None:
        """Waits until the client has read the last message, as far as can be known, or for a few seconds."""
        is_ahead = await self._wait(self._message_bytes // 4, trusts_silence=not self._is_ahead)
        self._is_ahead = self._is_ahead if is_ahead is None else is_ahead

    async def all_but_one(self) -> None:
        """Waits until the client has read all messages before the last one, as `none` does."""
        await self._wait(self._message_bytes * 3 // 2, trusts_silence=False)

    async def _wait(self, unread_bytes: int, *, trusts_silence: bool) -> bool | None:
        """Whether silence alone says that no more bytes than these are unread; None: that is not known."""
        loop = asyncio.get_running_loop()
        latest = loop.time() + _LONGEST_S
        while (state := self._state()) is not None and not self._transport.is_closing():
            if state.unacknowledged_bytes == 0:
                if state.window_bytes >= self._window_bytes - unread_bytes:
                    return False
                if trusts_silence and state.quiet_s > _QUIET_S:
                    return True
                if loop.time() > latest:
                    self._window_bytes = state.window_bytes
                    return None
            await asyncio.sleep(_POLL_S)
        return None

    def _state(self) -> _State | None:
        """None where the system does not tell."""
        if sys.platform != "linux" or self._socket is None or self._socket.fileno() < 0:
            return None
        info = self._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO_BYTES)
        if len(info) < _TCP_INFO_BYTES:
            return None
        unacknowledged = struct.unpack("i", fcntl.ioctl(self._socket.fileno(), _SIOCOUTQ, bytes(4)))[0]
        window = struct.unpack_from("I", info, _SEND_WINDOW_OFFSET)[0]
        quiet_ms = struct.unpack_from("I", info, _LAST_DATA_RECEIVED_OFFSET)[0]
        return _State(unacknowledged, window, quiet_ms / 1000)
