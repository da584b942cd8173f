"""Registrations by name: kept, listed, deleted, and found for the requests that name one."""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Concatenate, ParamSpec, TypeVar

import sqlalchemy as sa

from ultragray.contract import shown
from ultragray.errors import InvalidArgument
from ultragray.registration.registration import Registration
from ultragray_workers.errors import DatabaseUnavailable, RegistrationNotFound
from ultragray_workers.jobs.queue.owners import Kind, Ownership
from ultragray_workers.scene_names import base_name

from ..access.limits.limits import Limits
from ..access.owners import Owners, may_change
from ..access.principal import acting
from ..core.catalog import SceneCatalog, page_of_names
from ..core.jobs.database_threads import DatabaseThreads
from ..errors import LimitReached, PermissionDenied
from . import store
from .named import NamedRegistration, RegistrationPage

FRESH_S = 1.0  # a registration that another service changed is used for so long
RETRY_S = 5.0  # a registration is used for so long after the database did not tell it
HELD_PATIENCE_S = 1.0  # with the database, of a frame whose registration is held
MOST_HELD = 1024
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")

_log = logging.getLogger("ultragray.service")

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class _Held:
    kept: store.Kept
    until_s: float  # of time.monotonic(): it is used without asking the database


class Registrations:
    """All registrations of the installation.

    Whoever put one sees it. One of a private scene is for that scene's owner besides, whatever takes the name of the
    scene later; any other is there for all as long as they see its scene.
    """

    def __init__(self, catalog: SceneCatalog, owners: Owners, limits: Limits) -> None:
        self._catalog, self._owners, self._limits = catalog, owners, limits
        self._held: dict[str, _Held] = {}  # by name
        self._engine: sa.Engine | None = None
        self._threads: DatabaseThreads | None = None

    def open(self, engine: sa.Engine, threads: DatabaseThreads) -> None:
        """From now on they are read and written by `engine`, in `threads`."""
        self._engine, self._threads = engine, threads

    async def get(self, name: str) -> NamedRegistration:
        """A registration as it is kept now. Raises RegistrationNotFound, DatabaseUnavailable."""
        read = await self._do(store.read_registration, name)
        if read is None:
            self._held.pop(name, None)
        found = await asyncio.to_thread(self._seen, name, read)
        self._hold(found)
        return found.registration

    async def ownership(self, name: str) -> Ownership:
        """Whose a registration is. Raises RegistrationNotFound, DatabaseUnavailable."""
        return Ownership((await self.get(name)).owner)

    async def of_scene(self, name: str, scene: str) -> Registration:
        """The registration that a request for a scene names, at most a second old.

        While the database is away it is the one that this service last read, so that frames go on. Raises
        RegistrationNotFound, DatabaseUnavailable where none was read yet, and InvalidArgument for one of another scene.
        """
        held = self._held.get(name)
        if held is None:
            found = await self.get(name)
        elif (
            time.monotonic() > held.until_s
            or held.kept.origin.scene != base_name(scene)
            or not _is_seen(held.kept.origin, lambda scene: not self._owners.hides(Kind.SCENE, scene))
        ):
            found = await self._get_or_held(name, held.kept)
        else:
            found = held.kept.registration
        return _of_scene(found, scene)

    def read_of_scene(self, name: str, scene: str) -> Registration:
        """As `of_scene`, as it is kept now. Blocks; may be called from any thread."""
        return _of_scene(self._seen(name, store.read_registration(self._opened, name)).registration, scene)

    async def page(self, page_size: int, page_token: str) -> RegistrationPage:
        """One page by name. Raises InvalidArgument, DatabaseUnavailable."""
        origins, there = await self._do(store.read_origins), set(await self._catalog.names())
        seen = sorted(name for name, origin in origins.items() if _is_seen(origin, there.__contains__))
        names, next_page_token = page_of_names(seen, page_size, page_token)
        read = [await self._do(store.read_registration, name) for name in names]
        return RegistrationPage([one.registration for one in read if one is not None], next_page_token)

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
        into = (base_name(scene), whose.owner if whose.private else None)
        try:
            kept = await self._do(store.write_registration, name, *into, registration, acting(), most)
        except LimitReached as error:
            raise self._limits.refused("registrations", error) from None
        if kept is None:
            raise _not_own(name)
        self._hold(kept)
        return kept.registration

    async def delete(self, name: str) -> None:
        """Forgets a registration. Raises RegistrationNotFound, PermissionDenied, DatabaseUnavailable."""
        await self.get(name)
        if not await self._do(store.delete_registration, name, acting()):
            raise _not_own(name)
        self._held.pop(name, None)

    async def _get_or_held(self, name: str, held: store.Kept) -> NamedRegistration:
        try:
            return await asyncio.wait_for(self.get(name), HELD_PATIENCE_S)
        except (asyncio.TimeoutError, DatabaseUnavailable):
            _log.warning(f"the database does not answer: the registration {name!r} is used as it was last read")
            found = await asyncio.to_thread(self._seen, name, held)
            self._hold(found, for_s=RETRY_S)
            return found.registration

    def _seen(self, name: str, found: store.Kept | None) -> store.Kept:
        """What was read of a name, where the caller may see it. Blocks. Raises RegistrationNotFound."""
        if found is None or not _is_seen(found.origin, lambda scene: scene in self._catalog.shown_names()):
            raise RegistrationNotFound(f"there is no registration {shown(name)}", field="registration")
        return found

    def _hold(self, kept: store.Kept, for_s: float = FRESH_S) -> None:
        name = kept.registration.name
        self._held.pop(name, None)
        while len(self._held) >= MOST_HELD:
            self._held.pop(next(iter(self._held)))
        self._held[name] = _Held(kept, time.monotonic() + for_s)

    @property
    def _opened(self) -> sa.Engine:
        assert self._engine is not None
        return self._engine

    async def _do(self, work: Callable[Concatenate[sa.Engine, P], T], *arguments: P.args, **options: P.kwargs) -> T:
        assert self._threads is not None
        return await self._threads.ask(work, self._opened, *arguments, **options)


def _is_seen(origin: store.Origin, sees_scene: Callable[[str], bool]) -> bool:
    """Whether the caller sees a registration; `sees_scene`: whether the caller sees a scene, by its name."""
    if _is_own(origin.owner):
        return True
    return sees_scene(origin.scene) if origin.private_to is None else _is_own(origin.private_to)


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
