"""Registrations by name: kept, listed, deleted, and found for the requests that name one."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Concatenate, ParamSpec, TypeVar

import sqlalchemy as sa

from ultragray.contract import shown
from ultragray.errors import InvalidArgument
from ultragray.registration.registration import Registration
from ultragray_workers.errors import RegistrationNotFound
from ultragray_workers.jobs.queue.owners import Kind, Ownership
from ultragray_workers.scene_names import base_name

from ..access.limits.limits import Limits
from ..access.owners import Owners
from ..access.principal import acting
from ..core.catalog import SceneCatalog, page_of_names
from ..errors import LimitReached, PermissionDenied
from . import store
from .named import NamedRegistration, RegistrationPage

FRESH_S = 1.0  # a registration that another service changed is used for so long
MOST_HELD = 1024
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")

P = ParamSpec("P")
T = TypeVar("T")


class Registrations:
    """All registrations of the installation. Those of a scene that a caller may not see are not there for them."""

    def __init__(self, catalog: SceneCatalog, owners: Owners, limits: Limits) -> None:
        self._catalog, self._owners, self._limits = catalog, owners, limits
        self._held: dict[str, tuple[float, NamedRegistration]] = {}  # by name, with time.monotonic() when it was read
        self._engine: sa.Engine | None = None
        self._threads: Executor | None = None

    def open(self, engine: sa.Engine, threads: Executor) -> None:
        """From now on they are read and written by `engine`, in `threads`."""
        self._engine, self._threads = engine, threads

    async def get(self, name: str) -> NamedRegistration:
        """A registration as it is kept now. Raises RegistrationNotFound, DatabaseUnavailable."""
        self._held.pop(name, None)
        found = self._seen(name, await self._do(store.read_registration, name))
        self._hold(found)
        return found

    async def ownership(self, name: str) -> Ownership:
        """Whose a registration is. Raises RegistrationNotFound, DatabaseUnavailable."""
        return Ownership((await self.get(name)).owner)

    async def of_scene(self, name: str, scene: str) -> Registration:
        """The registration that a request for a scene names, at most a second old.

        Raises RegistrationNotFound, DatabaseUnavailable, and InvalidArgument for one of another scene.
        """
        read_at, found = self._held.get(name, (0.0, None))
        if found is None or time.monotonic() - read_at > FRESH_S or self._owners.hides(Kind.SCENE, found.scene):
            found = await self.get(name)
        return _of_scene(found, scene)

    def read_of_scene(self, name: str, scene: str) -> Registration:
        """As `of_scene`, as it is kept now. Blocks; may be called from any thread."""
        return _of_scene(self._seen(name, store.read_registration(self._opened, name)), scene)

    async def page(self, page_size: int, page_token: str) -> RegistrationPage:
        """One page by name. Raises InvalidArgument, DatabaseUnavailable."""
        scenes = await self._do(store.read_scenes)
        seen = sorted(name for name, scene in scenes.items() if not self._owners.hides(Kind.SCENE, scene))
        names, next_page_token = page_of_names(seen, page_size, page_token)
        read = [await self._do(store.read_registration, name) for name in names]
        return RegistrationPage([one for one in read if one is not None], next_page_token)

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
        most = self._limits.mine.registrations
        try:
            kept = await self._do(store.write_registration, name, base_name(scene), registration, acting(), most)
        except LimitReached as error:
            raise self._limits.refused("registrations", error) from None
        if kept is None:
            raise _not_own(name)
        self._hold(kept)
        return kept

    async def delete(self, name: str) -> None:
        """Forgets a registration. Raises RegistrationNotFound, PermissionDenied, DatabaseUnavailable."""
        await self.get(name)
        if not await self._do(store.delete_registration, name, acting()):
            raise _not_own(name)
        self._held.pop(name, None)

    def _seen(self, name: str, found: NamedRegistration | None) -> NamedRegistration:
        """What was read of a name, where the caller may see it. Raises RegistrationNotFound."""
        if found is None or self._owners.hides(Kind.SCENE, found.scene):
            raise RegistrationNotFound(f"there is no registration {shown(name)}", field="registration")
        return found

    def _hold(self, registration: NamedRegistration) -> None:
        self._held.pop(registration.name, None)
        while len(self._held) >= MOST_HELD:
            self._held.pop(next(iter(self._held)))
        self._held[registration.name] = (time.monotonic(), registration)

    @property
    def _opened(self) -> sa.Engine:
        assert self._engine is not None
        return self._engine

    async def _do(self, work: Callable[Concatenate[sa.Engine, P], T], *arguments: P.args, **options: P.kwargs) -> T:
        engine = self._opened
        return await asyncio.get_running_loop().run_in_executor(
            self._threads, lambda: work(engine, *arguments, **options)
        )


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
