"""The table of registrations. Its functions block; those that take an engine are one transaction each."""

from __future__ import annotations

import json
import logging
import time
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from ultragray.contract import from_dict, to_dict
from ultragray.errors import UltragrayError
from ultragray.registration.registration import Registration
from ultragray_service.access.principal import Principal, Role, iso_time
from ultragray_service.errors import LimitReached
from ultragray_service.registrations.named import NamedRegistration
from ultragray_workers.jobs.queue.owners import tell_change
from ultragray_workers.jobs.queue.tables import REGISTRATIONS

_log = logging.getLogger("ultragray.service")
_COLUMNS = REGISTRATIONS.c
_KNOWN = {item.name for item in fields(Registration)}  # a later release may write more


@dataclass(frozen=True)
class Kept:
    """A registration as its row has it."""

    registration: NamedRegistration
    private_to: str | None  # the owner of the scene, where that was private when the registration was put


def read_registration(engine: sa.Engine, name: str) -> Kept | None:
    """The registration of a name; None where there is none."""
    with engine.connect() as connection:
        row = connection.execute(sa.select(REGISTRATIONS).where(_COLUMNS.name == name)).one_or_none()
    return None if row is None else _kept(*row)


def read_registrations(connection: sa.Connection) -> dict[str, Kept]:
    """All registrations that can be read, by name."""
    found = {}
    for row in connection.execute(sa.select(REGISTRATIONS)):
        try:
            found[row.name] = _kept(*row)
        except (UltragrayError, ValueError) as error:
            _log.warning(f"the registration {row.name!r} cannot be read, and is left out: {error}")
    return found


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
        insert = (sqlite if connection.dialect.name == "sqlite" else postgresql).insert(REGISTRATIONS)
        kept = insert.values(name=name, owner=writer.name, **values).on_conflict_do_update(
            index_elements=[_COLUMNS.name], set_={**values, "owner": owner}, where=_may_change(writer)
        )
        row = connection.execute(kept.returning(*_COLUMNS)).one_or_none()
        if row is None:
            return None
        tell_change(connection)
    return _kept(*row)


def delete_registration(engine: sa.Engine, name: str, remover: Principal) -> bool:
    """Whether it was there and the remover's to delete."""
    with engine.begin() as connection:
        gone = sa.delete(REGISTRATIONS).where(_COLUMNS.name == name, _may_change(remover))
        if not connection.execute(gone).rowcount:
            return False
        tell_change(connection)
    return True


def _require_room(connection: sa.Connection, name: str, writer: Principal, most: int) -> None:
    """Raises LimitReached where the writer has `most` registrations, and none is there of that name."""
    if connection.execute(sa.select(_COLUMNS.name).where(_COLUMNS.name == name)).one_or_none() is not None:
        return
    owned = sa.select(sa.func.count()).select_from(REGISTRATIONS).where(_COLUMNS.owner == writer.name)
    if connection.execute(owned).scalar_one() >= most:
        raise LimitReached(f"this key may keep {most} registrations (registrations): delete one first")


def _may_change(principal: Principal) -> sa.ColumnElement[bool]:
    return sa.true() if principal.role is Role.ADMIN else _COLUMNS.owner == principal.name


@lru_cache(maxsize=4096)  # they are read again whenever one of them, a key or an owner changes
def _kept(name: str, scene: str, owner: str, changed_at_s: float, document: str, private_to: str | None) -> Kept:
    """The registration of a row, by its columns. Raises InvalidArgument, InvalidPose, ValueError."""
    content = {key: value for key, value in json.loads(document).items() if key in _KNOWN}
    facts: dict[str, Any] = {"name": name, "scene": scene, "owner": owner, "changed_at": iso_time(changed_at_s)}
    return Kept(NamedRegistration(**to_dict(from_dict(Registration, content)), **facts), private_to)
