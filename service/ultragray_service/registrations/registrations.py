"""Registrations by name: kept, listed, deleted, and found for the requests that name one."""

from __future__ import annotations

import asyncio
import re
import threading
from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

import sqlalchemy as sa

from ultragray.contract import shown
from ultragray.errors import InvalidArgument
from ultragray.registration.registration import Registration
from ultragray_service.access.limits.limits import Limits
from ultragray_service.access.owners import Owners, may_change
from ultragray_service.access.principal import acting
from ultragray_service.core.catalog import SceneCatalog, page_of_names
from ultragray_service.core.jobs.database_threads import DatabaseThreads
from ultragray_service.errors import LimitReached, PermissionDenied
from ultragray_service.registrations import store
from ultragray_service.registrations.named import NamedRegistration, RegistrationPage
from ultragray_workers.errors import RegistrationNotFound
from ultragray_workers.jobs.queue.owners import Kind, Ownership
from ultragray_workers.scene_names import base_name

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")

P = ParamSpec("P")
T = TypeVar("T")


class Registrations:
    """All registrations of the installation, and a copy of them in memory: no frame waits for the database.

    One that was put while its scene was private is seen by that scene's owner and by admins alone, also when the scene
    is gone and another has its name. Any other is seen by who put it, and by all who see its scene.
    """

    def __init__(self, catalog: SceneCatalog, owners: Owners, limits: Limits) -> None:
        self._catalog, self._owners, self._limits = catalog, owners, limits
        self._copy: dict[str, store.Kept] = {}  # by name
        self._changes = 0  # of the copy by this service, so that no older copy follows a newer one
        self._copying = threading.Lock()  # of the copy and the number of its changes
        self._writing = threading.Lock()  # one change of the table at a time: the copy has them in the same order
        self._engine: sa.Engine | None = None
        self._threads: DatabaseThreads | None = None

    def open(self, engine: sa.Engine, threads: DatabaseThreads) -> None:
        """From now on they are read and written by `engine`, in `threads`."""
        self._engine, self._threads = engine, threads

    def read(self, connection: sa.Connection) -> None:
        """Copies them again, waiting for no change that is under way. May be called from any thread."""
        while True:
            before, copy = self._changes, store.read_registrations(connection)
            with self._copying:
                if self._changes == before:
                    self._copy = copy
                    return

    async def get(self, name: str) -> NamedRegistration:
        """A registration as it is kept now. Raises RegistrationNotFound, DatabaseUnavailable."""
        kept = await self._do(store.read_registration, name)
        return await asyncio.to_thread(self._seen, name, kept)

    async def ownership(self, name: str) -> Ownership:
        """Whose a registration is. Raises RegistrationNotFound, DatabaseUnavailable."""
        return Ownership((await self.get(name)).owner)

    async def of_scene(self, name: str, scene: str) -> Registration:
        """The registration that a request for a scene names, from the copy.

        The database is asked where the copy lacks it, has it for another scene or hides it from the caller: another
        service may have changed it just now. Raises RegistrationNotFound, DatabaseUnavailable, and InvalidArgument for
        one of another scene.
        """
        kept = self._copy.get(name)
        if (
            kept is None
            or kept.registration.scene != base_name(scene)
            or not _is_seen(kept, lambda one: not self._owners.hides(Kind.SCENE, one))
        ):
            return _of_scene(await self.get(name), scene)
        return kept.registration

    def read_of_scene(self, name: str, scene: str) -> Registration:
        """As `of_scene`, as it is kept now. Blocks; may be called from any thread."""
        return _of_scene(self._seen(name, store.read_registration(self._opened, name)), scene)

    async def page(self, page_size: int, page_token: str) -> RegistrationPage:
        """One page by name. Raises InvalidArgument, DatabaseUnavailable."""
        kept, there = await self._do(_read_all), set(await self._catalog.names())
        seen = {name: one.registration for name, one in kept.items() if _is_seen(one, there.__contains__)}
        names, next_page_token = page_of_names(sorted(seen), page_size, page_token)
        return RegistrationPage([seen[name] for name in names], next_page_token)

    async def put(self, name: str, scene: str, registration: Registration) -> NamedRegistration:
        """Keeps a registration, in place of one of the name that is the caller's.

        Raises InvalidArgument for a name, SceneNotFound, SceneFileInvalid, PermissionDenied, LimitReached,
        DatabaseUnavailable.
        """
        if NAME.fullmatch(name) is None:
            raise InvalidArgument(
                "registration must be 1 to 128 letters, digits, '.', '_' and '-', the first a letter or digit, got "
                f"{shown(name)}",
                field="registration",
            )
        await self._catalog.header(scene)
        most, whose = self._limits.mine.registrations, self._owners.known(Kind.SCENE, scene)
        private_to = whose.owner if whose.private else None

        def write(engine: sa.Engine) -> NamedRegistration:
            with self._writing:
                kept = store.write_registration(
                    engine, name, base_name(scene), private_to, registration, acting(), most
                )
                if kept is None:
                    raise _not_own(name)
                self._change_copy(name, kept)
            return kept.registration

        try:
            return await self._do(write)
        except LimitReached as error:
            raise self._limits.refused("registrations", error) from None

    async def delete(self, name: str) -> None:
        """Forgets a registration. Raises RegistrationNotFound, PermissionDenied, DatabaseUnavailable."""

        def forget(engine: sa.Engine) -> None:
            with self._writing:
                if not store.delete_registration(engine, name, acting()):
                    raise _not_own(name)
                self._change_copy(name, None)

        await self.get(name)
        await self._do(forget)

    def _change_copy(self, name: str, kept: store.Kept | None) -> None:
        with self._copying:
            self._changes += 1
            if kept is None:
                self._copy.pop(name, None)
            else:
                self._copy[name] = kept

    def _seen(self, name: str, kept: store.Kept | None) -> NamedRegistration:
        """What was read of a name, where the caller may see it. Lists scenes: blocks. Raises RegistrationNotFound."""
        if kept is None or not _is_seen(kept, lambda scene: scene in self._catalog.shown_names()):
            raise RegistrationNotFound(f"there is no registration {shown(name)}", field="registration")
        return kept.registration

    @property
    def _opened(self) -> sa.Engine:
        assert self._engine is not None
        return self._engine

    async def _do(self, work: Callable[Concatenate[sa.Engine, P], T], *arguments: P.args, **options: P.kwargs) -> T:
        assert self._threads is not None
        return await self._threads.ask(work, self._opened, *arguments, **options)


def _read_all(engine: sa.Engine) -> dict[str, store.Kept]:
    with engine.connect() as connection:
        return store.read_registrations(connection)


def _is_seen(kept: store.Kept, sees_scene: Callable[[str], bool]) -> bool:
    """Whether the caller sees a registration; `sees_scene`: whether the caller sees a scene, by its name."""
    if kept.private_to is not None:
        return _is_own(kept.private_to)
    return _is_own(kept.registration.owner) or sees_scene(kept.registration.scene)


def _is_own(owner: str | None) -> bool:
    """Whether something is the caller's, or the caller an admin or the service itself."""
    try:
        return may_change(acting(), Ownership(owner))
    except LookupError:
        return True


def _of_scene(found: NamedRegistration, scene: str) -> NamedRegistration:
    if found.scene != base_name(scene):
        raise InvalidArgument(
            f"registration must be one of the scene {base_name(scene)!r}: {found.name!r} is of {found.scene!r}",
            field="registration",
        )
    return found


def _not_own(name: str) -> PermissionDenied:
    return PermissionDenied(
        f"the registration {name!r} is somebody else's: only its owner and admins change it", field="registration"
    )
