"""The buffers between the service and a client, in which frames grow old."""

from __future__ import annotations

import asyncio
import socket
from typing import cast

UNSENT_BYTES = 16 * 1024  # that the kernel may hold of a connection, beside those that are on their way


def hold_little(transport: asyncio.BaseTransport) -> None:
    """Has a transport ask to wait while it buffers anything, and the kernel take no more than it can send soon."""
    cast(asyncio.WriteTransport, transport).set_write_buffer_limits(high=0)
    if (endpoint := transport.get_extra_info("socket")) is not None:
        endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)
