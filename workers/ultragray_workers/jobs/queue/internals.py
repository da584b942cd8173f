"""All that the queue takes from DBOS beyond its public interface, with the reasons.

- `WORKFLOWS`: the columns are documented (docs.dbos.dev/explanations/system-tables), but reading and setting them is
  ours. DBOS does not count workflows by status, and reads their rows whole: 3 s for 40,000 jobs that wait. On SQLite it
  may know the time of a submission to the second only, while the queue is served and listed in order of submission.
- `put_back`: `DBOSClient.resume_workflow` would revive a job that was cancelled a moment ago, and would take a job from
  the worker that has just taken it over. DBOS's own recovery calls the same method as `put_back`.
- `take_back`: the same, and the attempt is not counted.
- `take_only_through`: DBOS takes whatever a queue holds; which worker can do a job is known to us alone. The demand of
  a job stands where DBOS keeps the partition of a queue, by which its rows are indexed. The queue is not declared
  partitioned: DBOS would serve the partitions one by one, in any order, with a transaction for each.
- `leave_others_room`: DBOS bounds the running jobs of a queue, or of a part of it by one number for all parts.
- `NotMine`: an execution that raises it ends without an entry in the queue. Any other error is kept as the job's end,
  even while another worker is at the job.
- `QUEUE_VERSION`, `latest_queue_version`: DBOS opens tables of a newer DBOS without a word.
- `SQLITE_SETTINGS`: to pass an engine of our own, whose errors are translated, is public; the settings that DBOS makes
  on its own engine for SQLite are not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import sqlalchemy as sa
from dbos import DBOS, DBOSClient
from dbos import error as dbos_error
from dbos._migration import get_dbos_migrations, sqlite_migrations
from sqlalchemy.dialects.postgresql import JSONB

NotMine = dbos_error.DBOSWorkflowConflictIDError

MOST_RUNNING = "most_running"  # attribute of a job: how many of its owner may run at once
SCHEMA = "dbos"  # on PostgreSQL; none on SQLite
SQLITE_SETTINGS = {"busy_timeout": 30_000, "foreign_keys": 1}
SQLITE_ISOLATION = "IMMEDIATE"

WORKFLOWS = sa.Table(
    "workflow_status",
    sa.MetaData(),
    sa.Column("workflow_uuid", sa.Text),
    sa.Column("name", sa.Text),
    sa.Column("status", sa.Text),
    sa.Column("queue_name", sa.Text),
    sa.Column("queue_partition_key", sa.Text),  # the key of the job's demand
    sa.Column("authenticated_user", sa.Text),
    sa.Column("application_version", sa.Text),
    sa.Column("executor_id", sa.Text),
    sa.Column("recovery_attempts", sa.BigInteger),
    sa.Column("attributes", sa.JSON().with_variant(JSONB(), "postgresql")),
    sa.Column("created_at", sa.BigInteger),  # ms
    schema=SCHEMA,
)

QUEUE_VERSION = sa.Table("dbos_migrations", sa.MetaData(), sa.Column("version", sa.BigInteger), schema=SCHEMA)


def latest_queue_version(dialect: str) -> int:
    """The version of the queue's tables that this release makes, which DBOS counts apart for SQLite and PostgreSQL."""
    if dialect == "sqlite":
        return len(sqlite_migrations)
    return len(get_dbos_migrations(SCHEMA, use_listen_notify=True, is_cockroach=False))


def put_back(client: DBOSClient, job_id: str, executor: str, queue: str) -> bool:
    """Puts a job that `executor` runs back into the queue; False where it does not run it (any more)."""
    return client._sys_db.reenqueue_for_recovery(job_id, [executor], queue)


def take_back(engine: sa.Engine, client: DBOSClient, job_id: str, executor: str, queue: str) -> bool:
    """Puts a job back that `executor` took and did not begin; False where it does not run it (any more)."""
    rows = WORKFLOWS.c
    with engine.begin() as connection:
        is_taken = sa.and_(rows.workflow_uuid == job_id, rows.status == "PENDING", rows.executor_id == executor)
        connection.execute(sa.update(WORKFLOWS).where(is_taken).values(recovery_attempts=rows.recovery_attempts - 1))
    return put_back(client, job_id, executor, queue)


def take_only_through(dbos: DBOS, queue: str, opens: Callable[[], Sequence[str]], close: Callable[[], None]) -> None:
    """Lets a worker take jobs of a queue only while a gate opens, and only those with a demand that it opens for.

    It is closed again where there was none to take.
    """
    take, rows = dbos._sys_db.start_queued_workflows, dbos._sys_db.tables.workflow_status
    demands: Sequence[str] = ()
    _add_condition(dbos, queue, lambda: rows.c.queue_partition_key.in_(demands))

    def take_if_open(asked: Any, *arguments: Any, **options: Any) -> Any:
        nonlocal demands
        if asked.name != queue:
            return take(asked, *arguments, **options)
        if not (demands := opens()):
            return [], None
        taken: list[str] = []
        try:
            taken, reason = take(asked, *arguments, **options)
            return taken, reason
        finally:
            if not taken:
                close()

    vars(dbos._sys_db)["start_queued_workflows"] = take_if_open


def leave_others_room(dbos: DBOS, queue: str) -> None:
    """Lets a worker take only jobs whose owner has fewer running than MOST_RUNNING among their attributes.

    Two workers that look in the same instant may start one more.
    """
    rows = dbos._sys_db.tables.workflow_status
    running = rows.alias("running")
    count = (
        sa.select(sa.func.count())
        .where(running.c.queue_name == queue, running.c.status == "PENDING")
        .where(running.c.authenticated_user == rows.c.authenticated_user)
        .correlate(rows)
        .scalar_subquery()
    )
    most: Any = rows.c.attributes[MOST_RUNNING].as_integer()
    has_room = sa.or_(most.is_(None), count < most)
    _add_condition(dbos, queue, lambda: has_room)


def _add_condition(dbos: DBOS, queue: str, condition: Callable[[], sa.ColumnElement[bool]]) -> None:
    """Lets a worker take only jobs of a queue that meet one more condition."""
    others = dbos._sys_db._claim_gate
    vars(dbos._sys_db)["_claim_gate"] = lambda name, partition: [
        *others(name, partition),
        *([condition()] if name == queue else []),
    ]
