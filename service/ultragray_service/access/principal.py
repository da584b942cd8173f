"""Roles and principals: who a request comes from, once its credential was checked."""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass
from datetime import datetime, timezone
from enum import Enum

from ultragray.contract import described
from ultragray_service.access.limits.allowance import Number
from ultragray_workers.pool.fairness.turns import Caller


class Role(str, Enum):
    """The roles, least first: each may do all that those before it may."""

    READER = "reader"  # sees, renders, streams
    OPERATOR = "operator"  # and has jobs, datasets and scenes
    ADMIN = "admin"  # and may do everything to everyone's

    def includes(self, other: Role) -> bool:
        """Whether this role may do what `other` may."""
        return _RANK[self] >= _RANK[other]


_RANK = {role: rank for rank, role in enumerate(Role)}


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
    """Whoever the running code works for."""
    principal = acting()
    at_s = principal.expires_at_s
    return Me(principal.name, principal.role, None if at_s is None else iso_time(at_s), key_required)


def iso_time(at_s: float) -> str:
    """A time.time() as ISO 8601, UTC."""
    return datetime.fromtimestamp(at_s, timezone.utc).isoformat(timespec="seconds")
