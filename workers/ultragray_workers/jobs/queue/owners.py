"""Owners of datasets and scenes, in a table beside the queue, so that a job and what it makes are claimed at once."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from .tables import CHANGES, OWNERS


class Kind(str, Enum):
    """Things that requests name. All but workers have an owner."""

    SCENE = "scene"
    DATASET = "dataset"
    JOB = "job"
    WORKER = "worker"


@dataclass(frozen=True)
class Ownership:
    """Whose something is, and whether others may see it."""

    owner: str | None = None  # None: nobody's, as what lay there before the service knew owners
    private: bool = False


NOBODYS = Ownership()


def set_owner(connection: sa.Connection, kind: Kind, name: str, ownership: Ownership) -> None:
    """Writes whose a dataset or scene is, whoever had the name before."""
    insert = (sqlite if connection.dialect.name == "sqlite" else postgresql).insert(OWNERS)
    values = {"owner": ownership.owner, "private": ownership.private}
    key = [OWNERS.c.kind, OWNERS.c.name]
    connection.execute(
        insert.values(kind=kind.value, name=name, **values).on_conflict_do_update(index_elements=key, set_=values)
    )
    tell_change(connection)


def forget_owner(connection: sa.Connection, kind: Kind, name: str) -> None:
    """Forgets whose a dataset or scene was that is gone."""
    connection.execute(sa.delete(OWNERS).where(OWNERS.c.kind == kind.value, OWNERS.c.name == name))
    tell_change(connection)


def read_owners(connection: sa.Connection) -> dict[tuple[Kind, str], Ownership]:
    """All owners, by kind and name."""
    rows = connection.execute(sa.select(OWNERS))
    return {(Kind(row.kind), row.name): Ownership(row.owner, row.private) for row in rows}


def tell_change(connection: sa.Connection) -> None:
    """Counts a change of keys or owners, in the transaction that makes it."""
    connection.execute(sa.update(CHANGES).values(number=CHANGES.c.number + 1))
