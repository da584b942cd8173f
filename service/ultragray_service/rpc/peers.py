"""The other end of a call."""

from __future__ import annotations

from urllib.parse import unquote


def address_of(peer: str) -> str:
    """The address of a peer as gRPC writes it: `ipv4:127.0.0.1:50000`, or `ipv6:%5B::1%5D:50000`."""
    return unquote(peer.partition(":")[2].rpartition(":")[0]).strip("[]")
