"""Addresses of this machine; and roles by address, for OpenIGTLink, whose clients have no key to show."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence

from ultragray.errors import InvalidArgument
from ultragray_service.access.principal import LOCAL, Principal, Role

_SOURCE = "igtl"
_FIELD = "igtl_allow"
_LOCALHOST = "localhost"
_Network = ipaddress.IPv4Network | ipaddress.IPv6Network


def is_loopback(host: str) -> bool:
    """Whether an address or name is that of this machine to itself."""
    if host.lower() == _LOCALHOST:
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def parse_allowed(entries: Sequence[str]) -> tuple[tuple[_Network, Role], ...]:
    """The networks of `10.0.0.7=reader` or `10.0.0.0/24=operator`, in their order. Raises InvalidArgument."""
    found = []
    for entry in entries:
        address, _, role = entry.partition("=")
        try:
            found.append((ipaddress.ip_network(address.strip()), Role(role.strip())))
        except ValueError:
            raise InvalidArgument(
                f"{_FIELD} must name addresses or networks with a role ({', '.join(Role)}), such as 10.0.0.7=reader or "
                f"10.0.0.0/24=reader, got {entry!r}",
                field=_FIELD,
            ) from None
    return tuple(found)


class AddressRoles:
    """Who may connect without a key: this machine, and the addresses that the setting `igtl_allow` names."""

    def __init__(self, allowed: Sequence[str]) -> None:
        self._allowed = parse_allowed(allowed)

    @property
    def is_local(self) -> bool:
        """Whether nobody but this machine may."""
        return not self._allowed

    def principal_of(self, address: str, *, asks: bool) -> Principal | None:
        """The principal at an address; None: it may not connect. `asks`: whether the other doors ask for keys."""
        at = ipaddress.ip_address(address)
        if isinstance(at, ipaddress.IPv6Address) and at.ipv4_mapped is not None:
            at = at.ipv4_mapped
        if at.is_loopback and not asks:
            return LOCAL
        role = next((role for network, role in self._allowed if at in network), None)
        if role is None and at.is_loopback:
            role = Role.READER
        return None if role is None else Principal(f"{_SOURCE}:{at}", role, _SOURCE)
