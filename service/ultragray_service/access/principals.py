"""Who asks: roles, principals, what each may take. Every door finds the principal of a request first."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import datetime, timezone
from enum import Enum
from typing import Any

from ultragray.contract import Contract, annotated_fields, described, from_text
from ultragray.errors import InvalidArgument
from ultragray_workers.pool.turns import Caller

Number = int | float
GB = 10**9
_UNLIMITED = "none"
_LIMIT_FIELD = "limit"


@dataclass(frozen=True, kw_only=True)
class Allowance(Contract):
    """How much one name may take, with however many keys; None: no limit."""

    requests_per_s: int | None = described(
        "Requests and calls of one key in any second; a stream is one; none: any number.", None, low=1, high=1_000_000
    )
    frames_per_s: int | None = described(
        "Frames of one key in any second, asked for one by one, in batches and in streams; none: any number.",
        None,
        low=1,
        high=1_000_000,
    )
    streams: int | None = described(
        "Streams of one key at once, over WebSocket, gRPC and OpenIGTLink; none: any number.",
        None,
        low=0,
        high=1_000_000,
    )
    unfinished_jobs: int | None = described(
        "Jobs of one key that wait or run at once; none: any number.", None, low=0, high=100_000
    )
    running_jobs: int | None = described(
        "Jobs of one key that run at once; more wait, and jobs of others go first; none: any number.",
        None,
        low=1,
        high=100_000,
    )
    compute_minutes_per_day: float | None = described(
        "Minutes that the jobs of one key may have run since midnight (UTC), on CPU and GPU together; then it submits "
        "no more that day; none: any number.",
        None,
        low=0.0,
        high=1e9,
    )
    stored_gb: float | None = described(
        "GB (1e9 bytes) of datasets, scenes and artifacts of one key; then it uploads and submits nothing; none: any "
        "number.",
        None,
        low=0.0,
        high=1e9,
    )
    registrations: int | None = described(
        "Registrations that one key keeps; none: any number.", None, low=0, high=1_000_000
    )


NAMES = tuple(item.name for item, _ in annotated_fields(Allowance))


def read_limits(texts: Sequence[str]) -> dict[str, Number | None]:
    """The limits that `frames_per_s=30` or `streams=none` give. Raises InvalidArgument."""
    annotations = {item.name: annotation for item, annotation in annotated_fields(Allowance)}
    limits: dict[str, Number | None] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if name not in annotations or not equals:
            raise InvalidArgument(
                f"limit must be NAME=NUMBER or NAME={_UNLIMITED}, with a NAME of {', '.join(NAMES)}, got {text!r}",
                field=_LIMIT_FIELD,
            )
        number: Any = None if value == _UNLIMITED else from_text(value, annotations[name])
        limits[name] = getattr(Allowance(**{name: number}), name)
    return limits


class Role(str, Enum):
    """The roles, least first: each may do all that those before it may."""

    READER = "reader"  # sees, renders, streams
    OPERATOR = "operator"  # and has jobs, datasets and scenes
    ADMIN = "admin"  # and may do everything to everyone's

    def includes(self, other: Role) -> bool:
        return [*Role].index(self) >= [*Role].index(other)


@dataclass(frozen=True)
class Principal:
    """Who asks. Two principals of one name are the same person: what one owns, the other owns.

    Only keys of the key store have names without a colon; every other source puts itself before it, such as
    `oidc:alice`, so that nobody gets the name of somebody else from another source.
    """

    name: str
    role: Role
    source: str  # what vouches for it: the id of a key, or the kind of source
    expires_at_s: float | None = None  # time.time() in seconds, from which on it counts no more; None: never
    limits: tuple[tuple[str, Number | None], ...] = ()  # its own, by the names of an Allowance


LOCAL = Principal("local:", Role.ADMIN, "open")  # everybody, where no keys are asked for

# Whoever the current request, call or stream belongs to. Tasks and threads that work for it inherit it.
_acting: ContextVar[Principal] = ContextVar("principal")
_caller: ContextVar[Caller] = ContextVar("caller")


def act_as(principal: Principal, *, address: str, connection: str) -> None:
    """From now on what runs in this context is done for `principal`, at an address, by one of its connections."""
    _acting.set(principal)
    _caller.set(Caller(address if principal is LOCAL else principal.name, connection))


def acting() -> Principal:
    """The principal that the running code works for. Raises LookupError outside of a request."""
    return _acting.get()


def caller() -> Caller:
    """Who takes turns with others for the running code: a principal with a name, else everybody at an address."""
    return _caller.get()


@dataclass(frozen=True)
class Me:
    """Whom a key stands for, and what they may do."""

    name: str = described("The owner of what they make.")
    role: Role = described("reader: sees, renders, streams; operator: and has jobs, datasets and scenes; admin: all.")
    expires_at: str | None = described("When the key counts no more, ISO 8601, UTC; null: never.")
    key_required: bool = described("Whether the service asks for keys; without, everybody is an admin.")


def me(key_required: bool) -> Me:
    principal = acting()
    at_s = principal.expires_at_s
    return Me(principal.name, principal.role, None if at_s is None else iso_time(at_s), key_required)


def iso_time(at_s: float) -> str:
    return datetime.fromtimestamp(at_s, timezone.utc).isoformat(timespec="seconds")


_SOURCE = "igtl"
_ALLOWED_FIELD = "igtl_allow"
_LOCALHOST = "localhost"
_Network = ipaddress.IPv4Network | ipaddress.IPv6Network


def is_loopback(host: str) -> bool:
    if host.lower() == _LOCALHOST:
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def parse_allowed(entries: Sequence[str]) -> tuple[tuple[_Network, Role], ...]:
    networks = []
    for entry in entries:
        address, _, role = entry.partition("=")
        try:
            networks.append((ipaddress.ip_network(address.strip()), Role(role.strip())))
        except ValueError:
            raise InvalidArgument(
                f"{_ALLOWED_FIELD} must name addresses or networks with a role ({', '.join(Role)}), such as "
                f"10.0.0.7=reader or 10.0.0.0/24=reader, got {entry!r}",
                field=_ALLOWED_FIELD,
            ) from None
    return tuple(networks)


class AddressRoles:
    """Who may connect without a key: this machine, and the addresses that the setting `igtl_allow` names."""

    def __init__(self, allowed: Sequence[str]) -> None:
        self._allowed = parse_allowed(allowed)

    @property
    def is_local(self) -> bool:
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
