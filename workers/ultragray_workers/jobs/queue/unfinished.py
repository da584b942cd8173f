"""The jobs that wait or run, asked for by what is needed of them only: there may be tens of thousands.

Each query goes by an index of DBOS, which SQLite takes only where the statuses stand in the query itself.
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa

from ultragray_workers.jobs.kinds import KINDS, Specification
from ultragray_workers.jobs.matching.demand import Demand, demand_of_key
from ultragray_workers.jobs.queue import database
from ultragray_workers.jobs.queue.database import JobDatabase
from ultragray_workers.jobs.queue.internals import WORKFLOWS

_ROWS = WORKFLOWS.c


def running(jobs: JobDatabase) -> list[tuple[str, str]]:
    """Each job that runs, with the worker that it is the job of."""
    found = sa.select(_ROWS.workflow_uuid, _ROWS.executor_id).where(_has_status(*database.RUNNING))
    with jobs.engine.connect() as connection:
        return [(row[0], row[1] or "") for row in connection.execute(found)]


def count_waiting(jobs: JobDatabase) -> int:
    """The number of jobs that wait."""
    is_job = sa.and_(_has_status(*database.QUEUED), _ROWS.name.in_(KINDS))
    counted = sa.select(sa.func.count()).select_from(WORKFLOWS).where(is_job)
    with jobs.engine.connect() as connection:
        return connection.execute(counted).scalar_one()


def demands_waiting(jobs: JobDatabase) -> list[str]:
    """The keys of the demands that jobs which wait have: one step in an index for each, however many jobs there are."""
    waits, key = _has_status(*database.QUEUED), _ROWS.queue_partition_key
    found = sa.select(sa.func.min(key).label("key")).where(waits, key.is_not(None)).cte("found", recursive=True)
    following = sa.select(sa.func.min(key)).where(waits, key > found.c.key).scalar_subquery()
    found = found.union_all(sa.select(following).where(found.c.key.is_not(None)))
    with jobs.engine.connect() as connection:
        return list(connection.execute(sa.select(found.c.key).where(found.c.key.is_not(None))).scalars())


def waiting(jobs: JobDatabase) -> list[tuple[Demand, int, int]]:
    """Each demand of jobs that wait, how many there are, and when the first was submitted, ms since 1970."""
    key = _ROWS.queue_partition_key
    grouped = sa.select(key, sa.func.count(), sa.func.min(_ROWS.created_at)).group_by(key)
    with jobs.engine.connect() as connection:
        rows = connection.execute(grouped.where(_has_status(*database.QUEUED))).all()
    return [(Demand() if row[0] is None else demand_of_key(row[0]), row[1], row[2]) for row in rows]


def count_of_owner(jobs: JobDatabase, owner: str) -> int:
    """The number of an owner's jobs that wait or run."""
    of_owner = sa.and_(_is_unfinished(), _ROWS.authenticated_user == owner, _ROWS.name.in_(KINDS))
    with jobs.engine.connect() as connection:
        return connection.execute(sa.select(sa.func.count()).select_from(WORKFLOWS).where(of_owner)).scalar_one()


def naming(jobs: JobDatabase, role: str, name: str) -> str | None:
    """A job that names a dataset or scene in a role, such as needs_dataset; None where there is none."""
    fields = {kind: getattr(Specification.member(kind), role) for kind in KINDS}
    names = [
        sa.and_(_ROWS.name == kind, _ROWS.attributes["specification"][field].as_string() == name)
        for kind, field in fields.items()
        if field is not None
    ]
    found = sa.select(_ROWS.workflow_uuid).where(_is_unfinished(), sa.or_(*names)).limit(1)
    with jobs.engine.connect() as connection:
        return connection.execute(found).scalar()


def successor(jobs: JobDatabase, job_id: str) -> str | None:
    """A job that goes on from this one; None where there is none."""
    found = sa.select(_ROWS.workflow_uuid).where(_is_unfinished(), _source() == job_id).limit(1)
    with jobs.engine.connect() as connection:
        return connection.execute(found).scalar()


def sources(jobs: JobDatabase) -> set[str]:
    """The jobs that others go on from."""
    found = sa.select(_source()).where(_is_unfinished(), _source().is_not(None)).distinct()
    with jobs.engine.connect() as connection:
        return set(connection.execute(found).scalars())


def adopt_older(jobs: JobDatabase) -> None:
    """Makes jobs that wait for a worker of an older release those of this one, which can do them too."""
    older = sa.and_(_has_status(*database.QUEUED), _ROWS.application_version.in_(database.OLDER_VERSIONS))
    with jobs.engine.begin() as connection:
        found = connection.execute(sa.select(_ROWS.workflow_uuid, _ROWS.attributes).where(older)).all()
        for job_id, attributes in found:
            adopted = sa.update(WORKFLOWS).where(_ROWS.workflow_uuid == job_id, older)
            key = Demand.of(attributes["specification"]).key
            connection.execute(adopted.values(application_version=database.VERSION, queue_partition_key=key))


def _source() -> sa.ColumnElement[Any]:
    source: sa.ColumnElement[Any] = _ROWS.attributes["retry_of"].as_string()
    return source


def _is_unfinished() -> sa.ColumnElement[bool]:
    either = [_written(status) for status in (*database.QUEUED, *database.RUNNING)]
    return sa.and_(_ROWS.queue_name == database.QUEUE, _ROWS.status.in_(either))


def _has_status(status: str) -> sa.ColumnElement[bool]:
    return sa.and_(_ROWS.queue_name == database.QUEUE, _ROWS.status == _written(status), _is_unfinished())


def _written(status: str) -> sa.ColumnElement[str]:
    return sa.literal_column(f"'{status}'")
