"""Connections of one door, counted in total and by address."""

from __future__ import annotations

from collections import Counter
from ipaddress import IPv6Address, ip_address

from ultragray_service.errors import TooManyConnections

_IPV6_NETWORK_BITS = 64  # what one subscriber has


class Connections:
    """The connections of one door. Each takes a place, and gives it back once."""

    def __init__(self, total: int, per_address: int) -> None:
        self._total = total
        self._per_address = per_address
        self._by_address: Counter[str] = Counter()
        self._count = 0

    def enter(self, host: str) -> Place:
        """A place for a connection from `host`. Raises TooManyConnections."""
        address = address_of(host)
        if self._by_address[address] >= self._per_address:
            raise TooManyConnections(f"at most {self._per_address} connections of one address may be open")
        if self._count >= self._total:
            raise TooManyConnections(f"at most {self._total} connections may be open")
        self._count += 1
        self._by_address[address] += 1
        return Place(self, address)

    def leave(self, address: str) -> None:
        """Gives back a place; `Place.leave` calls it."""
        self._count -= 1
        self._by_address[address] -= 1
        if not self._by_address[address]:
            del self._by_address[address]


class Place:
    """The place of one connection."""

    def __init__(self, connections: Connections, address: str) -> None:
        self._connections = connections
        self._address = address
        self._is_taken = True

    def leave(self) -> None:
        """Gives the place back, if that was not done before."""
        if self._is_taken:
            self._is_taken = False
            self._connections.leave(self._address)


def address_of(host: str) -> str:
    """What counts as one address: an IPv4 address, or the network of an IPv6 one."""
    address = ip_address(host.partition("%")[0])
    if not isinstance(address, IPv6Address):
        return str(address)
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(int(address) >> (128 - _IPV6_NETWORK_BITS))
