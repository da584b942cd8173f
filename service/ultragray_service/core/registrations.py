"""Registrations of robots and trackers to scenes, kept by name in the database, copied in memory for frames."""

from __future__ import annotations

import asyncio
import json
import logging
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Concatenate, ParamSpec, TypeVar

import sqlalchemy as sa

from ultragray.contract import described, from_dict, shown, to_dict
from ultragray.errors import InvalidArgument, UltragrayError
from ultragray.geometry.registration import Registration
from ultragray_service.access.limits import Limits
from ultragray_service.access.owners import Owners, may_change
from ultragray_service.access.principals import Principal, Role, acting, iso_time
from ultragray_service.core.jobs import DatabaseThreads
from ultragray_service.core.scenes import SceneCatalog, page_of_names
from ultragray_service.errors import LimitReached, PermissionDenied
from ultragray_workers.errors import RegistrationNotFound
from ultragray_workers.jobs.owners import Kind, Ownership, tell_change
from ultragray_workers.jobs.tables import REGISTRATIONS, insert
from ultragray_workers.scene_names import base_name


@dataclass(frozen=True, kw_only=True)
class NamedRegistration(Registration):
    """A registration that the service keeps."""

    name: str = described("Chosen by who put it.")
    scene: str = described("That its poses lead into.")
    owner: str | None = described("Who put it; null: nobody.", None)
    changed_at: str = described("ISO 8601, UTC.")


@dataclass(frozen=True)
class RegistrationPage:
    """One page of registrations by name."""

    registrations: list[NamedRegistration]
    next_page_token: str = described("Empty on the last page.")


_log = logging.getLogger("ultragray.service")
_COLUMNS = REGISTRATIONS.c


@dataclass(frozen=True)
class Kept:
    """A registration as its row has it."""

    registration: NamedRegistration
    private_to: str | None  # the owner of the scene, where that was private when the registration was put


def read_registration(engine: sa.Engine, name: str) -> Kept | None:
    with engine.connect() as connection:
        row = connection.execute(sa.select(REGISTRATIONS).where(_COLUMNS.name == name)).one_or_none()
    return None if row is None else _record_of(*row)


def read_registrations(connection: sa.Connection) -> dict[str, Kept]:
    registrations = {}
    for row in connection.execute(sa.select(REGISTRATIONS)):
        try:
            registrations[row.name] = _record_of(*row)
        except (UltragrayError, ValueError) as error:
            _log.warning(f"the registration {row.name!r} cannot be read, and is left out: {error}")
    return registrations


def write_registration(
    engine: sa.Engine,
    name: str,
    scene: str,
    private_to: str | None,
    registration: Registration,
    writer: Principal,
    most: int | None,
) -> Kept | None:
    """The registration as it is kept from now on; None where it is another's than the writer's.

    Its owner stays, unless an admin puts it for a private scene of somebody else's: then it is the admin's.
    Raises LimitReached for a new one of a writer who has `most` already; None: any number.
    """
    values = {
        "scene": scene,
        "private_to": private_to,
        "changed_at_s": time.time(),
        "document": json.dumps(to_dict(registration), allow_nan=False),
    }
    owner = (
        _COLUMNS.owner if private_to is None else sa.case((_COLUMNS.owner == private_to, private_to), else_=writer.name)
    )
    with engine.begin() as connection:
        if most is not None:
            _require_room(connection, name, writer, most)
        statement = (
            insert(connection, REGISTRATIONS)
            .values(name=name, owner=writer.name, **values)
            .on_conflict_do_update(
                index_elements=[_COLUMNS.name], set_={**values, "owner": owner}, where=_may_change(writer)
            )
        )
        row = connection.execute(statement.returning(*_COLUMNS)).one_or_none()
        if row is None:
            return None
        tell_change(connection)
    return _record_of(*row)


def delete_registration(engine: sa.Engine, name: str, remover: Principal) -> bool:
    with engine.begin() as connection:
        gone = sa.delete(REGISTRATIONS).where(_COLUMNS.name == name, _may_change(remover))
        if not connection.execute(gone).rowcount:
            return False
        tell_change(connection)
    return True


def _require_room(connection: sa.Connection, name: str, writer: Principal, most: int) -> None:
    if connection.execute(sa.select(_COLUMNS.name).where(_COLUMNS.name == name)).one_or_none() is not None:
        return
    owned = sa.select(sa.func.count()).select_from(REGISTRATIONS).where(_COLUMNS.owner == writer.name)
    if connection.execute(owned).scalar_one() >= most:
        raise LimitReached(f"this key may keep {most} registrations (registrations): delete one first")


def _may_change(principal: Principal) -> sa.ColumnElement[bool]:
    return sa.true() if principal.role is Role.ADMIN else _COLUMNS.owner == principal.name


@lru_cache(maxsize=4096)  # they are read again whenever one of them, a key or an owner changes
def _record_of(name: str, scene: str, owner: str, changed_at_s: float, document: str, private_to: str | None) -> Kept:
    facts: dict[str, Any] = {"name": name, "scene": scene, "owner": owner, "changed_at": iso_time(changed_at_s)}
    return Kept(NamedRegistration(**to_dict(from_dict(Registration, json.loads(document))), **facts), private_to)


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
        self._copy: dict[str, Kept] = {}  # by name
        self._changes = 0  # of the copy by this service, so that no older copy follows a newer one
        self._copying = threading.Lock()  # of the copy and the number of its changes
        self._writing = threading.Lock()  # one change of the table at a time: the copy has them in the same order
        self._engine: sa.Engine | None = None
        self._threads: DatabaseThreads | None = None

    def open(self, engine: sa.Engine, threads: DatabaseThreads) -> None:
        self._engine, self._threads = engine, threads

    def read(self, connection: sa.Connection) -> None:
        """Copies them again, waiting for no change that is under way. May be called from any thread."""
        while True:
            before, copy = self._changes, read_registrations(connection)
            with self._copying:
                if self._changes == before:
                    self._copy = copy
                    return

    async def get(self, name: str) -> NamedRegistration:
        record = await self._do(read_registration, name)
        return await asyncio.to_thread(self._visible, name, record)

    async def ownership(self, name: str) -> Ownership:
        return Ownership((await self.get(name)).owner)

    async def of_scene(self, name: str, scene: str) -> Registration:
        """The registration that a request for a scene names, from the copy.

        The database is asked where the copy lacks it, has it for another scene or hides it from the caller: another
        service may have changed it just now. Raises RegistrationNotFound, DatabaseUnavailable, and InvalidArgument for
        one of another scene.
        """
        record = self._copy.get(name)
        if (
            record is None
            or record.registration.scene != base_name(scene)
            or not _is_seen(record, lambda one: not self._owners.hides(Kind.SCENE, one))
        ):
            return _of_scene(await self.get(name), scene)
        return record.registration

    def read_of_scene(self, name: str, scene: str) -> Registration:
        """The registration that the database has now, else as `of_scene`. Blocks; may be called from any thread."""
        return _of_scene(self._visible(name, read_registration(self._open_engine, name)), scene)

    async def page(self, page_size: int, page_token: str) -> RegistrationPage:
        records, there = await self._do(_read_all), set(await self._catalog.names())
        registrations = {name: one.registration for name, one in records.items() if _is_seen(one, there.__contains__)}
        names, next_page_token = page_of_names(sorted(registrations), page_size, page_token)
        return RegistrationPage([registrations[name] for name in names], next_page_token)

    async def put(self, name: str, scene: str, registration: Registration) -> NamedRegistration:
        """Keeps a registration, in place of one of the name that is the caller's; else PermissionDenied is raised."""
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
                record = write_registration(engine, name, base_name(scene), private_to, registration, acting(), most)
                if record is None:
                    raise _not_own(name)
                self._change_copy(name, record)
            return record.registration

        try:
            return await self._do(write)
        except LimitReached as error:
            raise self._limits.refused("registrations", error) from None

    async def delete(self, name: str) -> None:
        def forget(engine: sa.Engine) -> None:
            with self._writing:
                if not delete_registration(engine, name, acting()):
                    raise _not_own(name)
                self._change_copy(name, None)

        await self.get(name)
        await self._do(forget)

    def _change_copy(self, name: str, record: Kept | None) -> None:
        with self._copying:
            self._changes += 1
            if record is None:
                self._copy.pop(name, None)
            else:
                self._copy[name] = record

    def _visible(self, name: str, record: Kept | None) -> NamedRegistration:
        """The registration of a record that the caller may see. Lists scenes: blocks. Raises RegistrationNotFound."""
        if record is None or not _is_seen(record, lambda scene: scene in self._catalog.shown_names()):
            raise RegistrationNotFound(f"there is no registration {shown(name)}", field="registration")
        return record.registration

    @property
    def _open_engine(self) -> sa.Engine:
        assert self._engine is not None
        return self._engine

    async def _do(self, work: Callable[Concatenate[sa.Engine, P], T], *arguments: P.args, **options: P.kwargs) -> T:
        assert self._threads is not None
        return await self._threads.ask(work, self._open_engine, *arguments, **options)


def _read_all(engine: sa.Engine) -> dict[str, Kept]:
    with engine.connect() as connection:
        return read_registrations(connection)


def _is_seen(record: Kept, sees_scene: Callable[[str], bool]) -> bool:
    if record.private_to is not None:
        return _is_own(record.private_to)
    return _is_own(record.registration.owner) or sees_scene(record.registration.scene)


def _is_own(owner: str | None) -> bool:
    """Whether something is the caller's, or the caller an admin or the service itself."""
    try:
        return may_change(acting(), Ownership(owner))
    except LookupError:
        return True


def _of_scene(link: NamedRegistration, scene: str) -> NamedRegistration:
    if link.scene != base_name(scene):
        raise InvalidArgument(
            f"registration must be one of the scene {base_name(scene)!r}: {link.name!r} is of {link.scene!r}",
            field="registration",
        )
    return link


def _not_own(name: str) -> PermissionDenied:
    return PermissionDenied(
        f"the registration {name!r} is somebody else's: only its owner and admins change it", field="registration"
    )
