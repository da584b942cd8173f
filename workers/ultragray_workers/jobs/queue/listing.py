"""Pages of jobs, newest first, and how many jobs there are in each state.

The token of a page is the place between two jobs, which later jobs do not move.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Callable, Sequence
from datetime import datetime, timezone

import sqlalchemy as sa
from dbos import WorkflowStatus

from ultragray.errors import InvalidArgument
from ultragray_workers.jobs.kinds import KINDS
from ultragray_workers.jobs.queue.database import JobDatabase
from ultragray_workers.jobs.queue.internals import WORKFLOWS


def count_by_status(jobs: JobDatabase) -> dict[str, int]:
    """The number of jobs with each of DBOS's statuses. One pass over the rows: 2 ms for 10,000 jobs in SQLite."""
    rows = WORKFLOWS.c
    counted = sa.select(rows.status, sa.func.count()).where(rows.name.in_(KINDS)).group_by(rows.status)
    with jobs.engine.begin() as connection:
        return {row[0]: row[1] for row in connection.execute(counted)}


def ids_of_owner(jobs: JobDatabase, owner: str) -> list[str]:
    """The jobs of an owner, whatever became of them."""
    rows = WORKFLOWS.c
    found = sa.select(rows.workflow_uuid).where(rows.name.in_(KINDS), rows.authenticated_user == owner)
    with jobs.engine.connect() as connection:
        return list(connection.execute(found).scalars())


def page_of_rows(
    jobs: JobDatabase,
    *,
    kind: str | None,
    statuses: Sequence[str] | None,
    shown: Callable[[WorkflowStatus], bool],
    page_size: int,
    page_token: str | None,
) -> tuple[list[WorkflowStatus], str | None]:
    """The rows of one page, of those that are `shown`, and the token of the next; None on the last.

    Raises InvalidArgument for a token that no page gave.
    """
    place: _Place = (None, []) if page_token is None else read_token(page_token)
    found: list[WorkflowStatus] = []
    reading, some = place, page_size + 1  # one more than the page tells whether there is another
    while True:
        rows = _rows_after(jobs, kind, statuses, reading, some)
        found += [row for row in rows if shown(row)]
        if len(found) > page_size or len(rows) < some:
            break
        reading = _after(rows, reading)
    page = found[:page_size]
    return page, write_token(*_after(page, place)) if len(found) > page_size else None


_Place = tuple[
    int | None, list[str]
]  # the time of a job, in ms, and the jobs of that very millisecond before the place


def _rows_after(
    jobs: JobDatabase, kind: str | None, statuses: Sequence[str] | None, place: _Place, limit: int
) -> list[WorkflowStatus]:
    before_ms, seen = place
    rows = jobs.client.list_workflows(
        name=list(KINDS) if kind is None else kind,
        status=None if statuses is None else list(statuses),
        end_time=None if before_ms is None else _iso_after(before_ms),
        sort_desc=True,
        limit=limit + len(seen),
        load_input=False,
    )
    return [row for row in rows if row.workflow_id not in seen][:limit]


def _after(rows: Sequence[WorkflowStatus], place: _Place) -> tuple[int, list[str]]:
    """The place after the last of some rows, which begin at `place`."""
    last_ms = rows[-1].created_at
    assert last_ms is not None
    before_ms, seen = place
    return last_ms, [row.workflow_id for row in rows if row.created_at == last_ms] + (
        seen if before_ms == last_ms else []
    )


def _iso_after(epoch_ms: int) -> str:
    """Half a millisecond later: DBOS rounds down, and may by then have lost the last bit."""
    return datetime.fromtimestamp((epoch_ms + 0.5) / 1000, timezone.utc).isoformat()


def write_token(last_ms: int, seen: list[str]) -> str:
    """The place after the last job of a page; `seen`: the listed jobs of that very millisecond."""
    return base64.urlsafe_b64encode(json.dumps([last_ms, seen]).encode()).decode()


def read_token(token: str) -> tuple[int, list[str]]:
    """Inverse of `write_token`. Raises InvalidArgument."""
    try:
        last_ms, seen = json.loads(base64.urlsafe_b64decode(token))
        is_seen = isinstance(seen, list) and all(isinstance(job_id, str) for job_id in seen)
        if isinstance(last_ms, int) and 0 <= last_ms < 2**43 and is_seen:
            return last_ms, seen
    except (ValueError, TypeError, RecursionError, binascii.Error):
        pass
    raise InvalidArgument(f"page_token must be one that a page gave, got {token[:64]!r}", field="page_token")
