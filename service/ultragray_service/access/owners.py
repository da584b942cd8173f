"""Whose datasets, scenes and jobs are, and who may see them: the copy in memory, and what changes it."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from concurrent.futures import Executor
from contextlib import asynccontextmanager

import sqlalchemy as sa

from ultragray_workers.jobs.queue.owners import NOBODYS, Kind, Ownership, forget_owner, read_owners, set_owner

from .principal import Principal, Role, acting

_KEPT_JOBS = 10_000


class Owners:
    """Knows owners without asking the database, but for those of jobs that nobody asked for before."""

    def __init__(
        self, job_ownership: Callable[[str], Awaitable[Ownership]], find: Mapping[Kind, Callable[[str], object]]
    ) -> None:
        """`job_ownership`: reads the owner of a job, which never changes. Raises JobNotFound.

        `find`: raises DatasetNotFound or SceneNotFound where there is no such thing; it blocks.
        """
        self._known: dict[tuple[Kind, str], Ownership] = {}
        self._jobs: dict[str, Ownership] = {}
        self._job_ownership = job_ownership
        self._find = find
        self._changing = threading.Lock()  # of the table and its copy, so that no older copy follows a newer one
        self._engine: sa.Engine | None = None
        self._threads: Executor | None = None

    def open(self, engine: sa.Engine, threads: Executor) -> None:
        """From now on changes are written by `engine`, in `threads`."""
        self._engine, self._threads = engine, threads

    def read(self, connection: sa.Connection) -> None:
        """Reads the owners of datasets and scenes again. May be called from any thread."""
        with self._changing:
            self._known = read_owners(connection)

    def known(self, kind: Kind, name: str) -> Ownership:
        """Whose a dataset or scene is."""
        return self._known.get((kind, name), NOBODYS)

    def owned(self, kind: Kind, owner: str) -> list[str]:
        """The datasets or scenes of an owner. May be called from any thread."""
        with self._changing:
            return [name for (one, name), whose in self._known.items() if one is kind and whose.owner == owner]

    async def of(self, kind: Kind, name: str) -> Ownership:
        """Whose something is. Raises JobNotFound."""
        return await self._of_job(name) if kind is Kind.JOB else self.known(kind, name)

    async def require_existing(self, kind: Kind, name: str) -> None:
        """Raises DatasetNotFound or SceneNotFound, also for what is hidden."""
        if kind in self._find:
            await asyncio.to_thread(self._find[kind], name)

    async def _of_job(self, job_id: str) -> Ownership:
        found = self._jobs.get(job_id)
        if found is None:
            found = await self._job_ownership(job_id)
            if len(self._jobs) >= _KEPT_JOBS:
                self._jobs.clear()
            self._jobs[job_id] = found
        return found

    def hides(self, kind: Kind, name: str) -> bool:
        """Whether a dataset or scene is private to somebody else than who the running code works for."""
        ownership = self._known.get((kind, name))
        if ownership is None or not ownership.private:
            return False
        try:
            return not may_see(acting(), ownership)
        except LookupError:  # the service itself
            return False

    async def set(self, kind: Kind, name: str, ownership: Ownership) -> None:
        """Makes a dataset or scene somebody's. Raises DatabaseUnavailable."""

        def change(connection: sa.Connection) -> None:
            set_owner(connection, kind, name, ownership)
            self._known[kind, name] = ownership

        await self._write(change)

    async def forget(self, kind: Kind, name: str) -> None:
        """Forgets whose a dataset or scene was that is gone. Raises DatabaseUnavailable."""

        def change(connection: sa.Connection) -> None:
            forget_owner(connection, kind, name)
            self._known.pop((kind, name), None)

        if (kind, name) in self._known:
            await self._write(change)

    async def _write(self, change: Callable[[sa.Connection], None]) -> None:
        assert self._engine is not None
        engine = self._engine

        def write() -> None:
            with self._changing, engine.begin() as connection:
                change(connection)

        await asyncio.get_running_loop().run_in_executor(self._threads, write)


class Claim:
    """A dataset or scene that the caller is about to make."""

    def __init__(self, owners: Owners, kind: Kind, name: str, *, private: bool) -> None:
        self._owners, self._kind, self._name = owners, kind, name
        self._ownership = Ownership(acting().name, private)

    @asynccontextmanager
    async def making(self, *, taken: bool) -> AsyncIterator[None]:
        """Hides what is to be private before the body makes it, also on other services, unless the name is `taken`."""
        if taken or not self._ownership.private:
            yield
            return
        await self._owners.set(self._kind, self._name, self._ownership)
        try:
            yield
        except BaseException:
            if self._owners.known(self._kind, self._name) is self._ownership:  # nobody was quicker
                await self._owners.forget(self._kind, self._name)
            raise

    async def made(self) -> None:
        """Says whose it is, now that it is there: whoever made it, where two tried at once."""
        await self._owners.set(self._kind, self._name, self._ownership)


def may_see(principal: Principal, ownership: Ownership) -> bool:
    """Whether something is there at all, as a principal sees it."""
    return not ownership.private or may_change(principal, ownership)


def may_change(principal: Principal, ownership: Ownership) -> bool:
    """Whether a principal may delete, cancel or retry something."""
    return principal.role is Role.ADMIN or principal.name == ownership.owner
