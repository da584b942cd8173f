"""Owners of datasets and scenes, in a table beside the queue, so that a job and what it makes are claimed at once."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import sqlalchemy as sa

from ultragray_workers.jobs.tables import CHANGES, OWNERS, insert


class Kind(str, Enum):
    """Things that requests name. All but workers have an owner; registrations keep theirs with their row."""

    SCENE = "scene"
    DATASET = "dataset"
    JOB = "job"
    WORKER = "worker"
    REGISTRATION = "registration"


@dataclass(frozen=True)
class Ownership:
    """Whose something is, and whether others may see it."""

    owner: str | None = None  # None: nobody's, as what lay there before the service knew owners
    private: bool = False
    claim: str | None = None  # of a dataset or scene: tells it from an earlier one of its name and owner


NOBODYS = Ownership()


def claim_of_job(job_id: str) -> str:
    """The claim of a job to the scene that it makes. Uploads claim by the name of the folder that they come in."""
    return f"job-{job_id}"


def add_owner(connection: sa.Connection, kind: Kind, name: str, ownership: Ownership) -> bool:
    """Whether a dataset or scene is now this owner's; False where the name is somebody's already."""
    values = {"owner": ownership.owner, "private": ownership.private, "claim": ownership.claim}
    new = insert(connection, OWNERS).values(kind=kind.value, name=name, **values)
    adding = new.on_conflict_do_nothing().returning(OWNERS.c.name)
    if connection.execute(adding).first() is None:
        return False
    tell_change(connection)
    return True


def read_owner(connection: sa.Connection, kind: Kind, name: str) -> Ownership:
    row = connection.execute(sa.select(OWNERS).where(*_is(kind, name))).one_or_none()
    return NOBODYS if row is None else Ownership(row.owner, row.private, row.claim)


def forget_owner(connection: sa.Connection, kind: Kind, name: str, ownership: Ownership) -> None:
    """Forgets whose a dataset or scene was that is gone, or was not made; nothing where the name is another's now."""
    is_same = (OWNERS.c.owner == ownership.owner, OWNERS.c.claim.is_not_distinct_from(ownership.claim))
    if connection.execute(sa.delete(OWNERS).where(*_is(kind, name), *is_same)).rowcount:
        tell_change(connection)


def read_owners(connection: sa.Connection) -> dict[tuple[Kind, str], Ownership]:
    rows = connection.execute(sa.select(OWNERS))
    return {(Kind(row.kind), row.name): Ownership(row.owner, row.private, row.claim) for row in rows}


def _is(kind: Kind, name: str) -> tuple[sa.ColumnElement[bool], sa.ColumnElement[bool]]:
    return OWNERS.c.kind == kind.value, OWNERS.c.name == name


def tell_change(connection: sa.Connection) -> None:
    """Counts a change of keys, owners or registrations, in the transaction that makes it."""
    connection.execute(sa.update(CHANGES).values(number=CHANGES.c.number + 1))
