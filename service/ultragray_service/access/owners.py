"""Whose datasets, scenes and jobs are, and who may see and change them; and the admission of what callers ask for."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from concurrent.futures import Executor
from contextlib import asynccontextmanager
from typing import TypeVar

import sqlalchemy as sa

from ultragray_service.access.audit import AuditLog
from ultragray_service.access.credentials import Sessions
from ultragray_service.access.limits import Limits
from ultragray_service.access.principals import Principal, Role, act_as, acting
from ultragray_service.access.rules import Operation
from ultragray_service.errors import PermissionDenied
from ultragray_workers.errors import job_not_found
from ultragray_workers.jobs.owners import NOBODYS, Kind, Ownership, add_owner, forget_owner, read_owner, read_owners
from ultragray_workers.scene_names import base_name

SPREAD_S = 2.0  # in which every service has read who owns what again, see `snapshot`

T = TypeVar("T")


class Owners:
    """Knows whose datasets and scenes are without asking the database; those of other things stand with their rows."""

    def __init__(self) -> None:
        self._known: dict[tuple[Kind, str], Ownership] = {}
        self._changing = threading.Lock()  # of the table and its copy, so that no older copy follows a newer one
        self._engine: sa.Engine | None = None
        self._threads: Executor | None = None

    def open(self, engine: sa.Engine, threads: Executor) -> None:
        self._engine, self._threads = engine, threads

    def read(self, connection: sa.Connection) -> None:
        """Reads the owners of datasets and scenes again. May be called from any thread."""
        with self._changing:
            self._known = read_owners(connection)

    def known(self, kind: Kind, name: str) -> Ownership:
        """Whose a dataset or scene is; a scene also by its name with a pin."""
        return self._known.get((kind, base_name(name) if kind is Kind.SCENE else name), NOBODYS)

    def owned(self, kind: Kind, owner: str) -> list[str]:
        with self._changing:
            return [name for (one, name), whose in self._known.items() if one is kind and whose.owner == owner]

    def hides(self, kind: Kind, name: str) -> bool:
        """Whether a dataset or scene is private to somebody else than who the running code works for."""
        ownership = self._known.get((kind, name))
        if ownership is None or not ownership.private:
            return False
        try:
            return not may_see(acting(), ownership)
        except LookupError:  # the service itself
            return False

    def require_change(self, kind: Kind, name: str) -> None:
        """Raises PermissionDenied where the running code works for somebody who may not change a dataset or scene."""
        principal, ownership = acting(), self.known(kind, name)
        if not may_change(principal, ownership):
            raise _not_theirs(f"a change of the {kind.value}", kind, name, ownership)

    async def claim(
        self, kind: Kind, name: str, ownership: Ownership, is_there: Callable[[str | None], Awaitable[bool]]
    ) -> bool:
        """Whether a dataset or scene is to be this owner's: somebody else has the name otherwise.

        `is_there`: whether what an earlier claim of the name is to is there, or is being made. If not, whoever claimed
        it died. Raises DatabaseUnavailable.
        """

        def add(connection: sa.Connection) -> Ownership:
            if not add_owner(connection, kind, name, ownership):
                return read_owner(connection, kind, name)
            self._known[kind, name] = ownership
            return ownership

        while (holder := await self._write(add)) != ownership:
            if holder != NOBODYS and await is_there(holder.claim):
                return False
            await self.forget(kind, name, holder)
        return True

    async def forget(self, kind: Kind, name: str, ownership: Ownership) -> None:
        """Forgets whose a dataset or scene was, unless the name is another's now. Raises DatabaseUnavailable."""

        def change(connection: sa.Connection) -> None:
            forget_owner(connection, kind, name, ownership)
            if self._known.get((kind, name)) == ownership:
                del self._known[kind, name]

        await self._write(change)

    @asynccontextmanager
    async def removing(self, kind: Kind, name: str) -> AsyncIterator[None]:
        ownership = await self._write(lambda connection: read_owner(connection, kind, name))
        yield
        await self.forget(kind, name, ownership)

    async def _write(self, change: Callable[[sa.Connection], T]) -> T:
        """A cancelled caller waits for the end of the transaction all the same."""
        assert self._engine is not None
        engine = self._engine

        def write() -> T:
            with self._changing, engine.begin() as connection:
                return change(connection)

        writing = asyncio.get_running_loop().run_in_executor(self._threads, write)
        try:
            return await asyncio.shield(writing)
        finally:
            await asyncio.wait({writing})


class Claim:
    """A dataset or scene that the caller is about to make."""

    def __init__(self, owners: Owners, kind: Kind, name: str, token: str, *, private: bool) -> None:
        self._owners, self._kind, self._name = owners, kind, name
        self._ownership = Ownership(acting().name, private, token)
        self._taken_at_s: float | None = None
        self.is_made = False  # told by who makes it, from any thread

    async def take(self, is_there: Callable[[str | None], Awaitable[bool]]) -> bool:
        """Claims the name, as `Owners.claim` does; what is to be private is hidden from here on."""
        if self._taken_at_s is None:
            self._taken_at_s = time.monotonic()
        return await self._owners.claim(self._kind, self._name, self._ownership, is_there)

    async def spread(self) -> None:
        """Returns when other services know the claim, if what it is to is to be hidden."""
        if self._ownership.private and self._taken_at_s is not None:
            await asyncio.sleep(self._taken_at_s + SPREAD_S - time.monotonic())

    @asynccontextmanager
    async def held(self) -> AsyncIterator[None]:
        """Gives the name back at the end of the body, unless what it names was made."""
        try:
            yield
        finally:
            if self._taken_at_s is not None and not self.is_made:
                await self._owners.forget(self._kind, self._name, self._ownership)


def may_see(principal: Principal, ownership: Ownership) -> bool:
    return not ownership.private or may_change(principal, ownership)


def may_change(principal: Principal, ownership: Ownership) -> bool:
    return principal.role is Role.ADMIN or principal.name == ownership.owner


class Admission:
    """Counts, audits and permits what callers ask for, whichever door it came through."""

    def __init__(
        self,
        audit: AuditLog,
        limits: Limits,
        sessions: Sessions,
        owners: Owners,
        kept_with_rows: Mapping[Kind, Callable[[str], Awaitable[Ownership]]],
        find: Mapping[Kind, Callable[[str], object]],
    ) -> None:
        """`kept_with_rows` reads owners of jobs and registrations; `find` blocks, and raises for what is not there."""
        self._audit, self._limits, self._sessions, self._owners = audit, limits, sessions, owners
        self._kept_with_rows, self._find = kept_with_rows, find

    @asynccontextmanager
    async def permitted(
        self,
        principal: Principal,
        credential: str | None,
        operation: Operation,
        target: str,
        *,
        address: str,
        connection: str,
    ) -> AsyncIterator[None]:
        """What a caller may do runs within: counted, audited, and cut off when the credential counts no more.

        `connection`: the caller's address with the port. Raises RateLimited, PermissionDenied and JobNotFound.
        """
        act_as(principal, address=address, connection=connection)
        caller = principal.name, address, operation, target
        with self._audit.refusals(*caller):
            self._limits.take_request()
        with self._audit.request(*caller), self._sessions.held(principal, credential):
            await self._require(principal, operation, target)
            yield

    async def _require(self, principal: Principal, operation: Operation, name: str) -> None:
        """Raises PermissionDenied, and JobNotFound for another's private job; see also `Owners.hides`."""
        if operation.role is not None and not principal.role.includes(operation.role):
            needed, has = operation.role.value, principal.role.value
            raise PermissionDenied(f"{operation.name} needs the role {needed}, and {principal.name} has {has}")
        about = operation.about
        if about is None or principal.role is Role.ADMIN or not (operation.owned or about is Kind.JOB):
            return
        read = self._kept_with_rows.get(about)
        ownership = self._owners.known(about, name) if read is None else await read(name)
        if about is Kind.JOB and not may_see(principal, ownership):
            raise job_not_found(name)
        if operation.owned and not may_change(principal, ownership):
            if about in self._find:  # something that is not there, or hidden, is nobody's
                await asyncio.to_thread(self._find[about], name)
            raise _not_theirs(operation.name, about, name, ownership)


def _not_theirs(what: str, kind: Kind, name: str, ownership: Ownership) -> PermissionDenied:
    whose = "nobody's" if ownership.owner is None else f"{ownership.owner}'s"
    return PermissionDenied(
        f"{what} needs the role {Role.ADMIN.value}, or to be the owner's: the {kind.value} {name[:128]!r} is {whose}",
        field=kind.value,
    )
