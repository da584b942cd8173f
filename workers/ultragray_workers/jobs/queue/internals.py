"""All that the queue takes from DBOS beyond its public interface, with the reasons.

- `WORKFLOWS`: the columns are documented (docs.dbos.dev/explanations/system-tables), but reading and setting them is
  ours: DBOS does not count workflows by status, and on SQLite it may know the time of a submission to the second only,
  while the queue is served and listed in the order of submissions.
- `put_back`: `DBOSClient.resume_workflow` would revive a job that was cancelled a moment ago, and would take a job from
  the worker that has just taken it over. DBOS's own recovery calls the same method as `put_back`.
- `NotMine`: an execution that raises it ends without an entry in the queue. Any other error is kept as the job's end,
  even while another worker is at the job.
- `SQLITE_SETTINGS`: to pass an engine of our own, whose errors are translated, is public; the settings that DBOS makes
  on its own engine for SQLite are not.
"""

from __future__ import annotations

import sqlalchemy as sa
from dbos import DBOSClient
from dbos import error as dbos_error

NotMine = dbos_error.DBOSWorkflowConflictIDError

SCHEMA = "dbos"  # on PostgreSQL; none on SQLite
SQLITE_SETTINGS = {"busy_timeout": 30_000, "foreign_keys": 1}
SQLITE_ISOLATION = "IMMEDIATE"

WORKFLOWS = sa.Table(
    "workflow_status",
    sa.MetaData(),
    sa.Column("workflow_uuid", sa.Text),
    sa.Column("name", sa.Text),
    sa.Column("status", sa.Text),
    sa.Column("executor_id", sa.Text),
    sa.Column("created_at", sa.BigInteger),  # ms
    schema=SCHEMA,
)


def put_back(client: DBOSClient, job_id: str, executor: str, queue: str) -> bool:
    """Puts a job that `executor` runs back into the queue; False where it does not run it (any more)."""
    return client._sys_db.reenqueue_for_recovery(job_id, [executor], queue)
