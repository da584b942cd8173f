"""The database under the queue: where it is, and what both the store and the workers read from it."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from dbos import DBOS, DBOSClient, DBOSPortableJSONSerializer, EnqueueOptions, WorkflowStatus
from sqlalchemy.exc import SQLAlchemyError

from ultragray.errors import StartupFailed

APPLICATION = "ultragray"
VERSION = "1"  # of the workflow's inputs and steps: workers take the jobs of their own version only
QUEUE = "ultragray-jobs"
SQLITE_FILE = "jobs.sqlite"

QUEUED = ("ENQUEUED", "DELAYED")
RUNNING = ("PENDING",)
SUCCEEDED = ("SUCCESS",)
FAILED = ("ERROR", "MAX_RECOVERY_ATTEMPTS_EXCEEDED")
CANCELLED = ("CANCELLED",)

# Rows hold JSON, never pickles: whoever can write to the database must not run code in the service.
SERIALIZER = DBOSPortableJSONSerializer()


def database_url_or_default(database_url: str | None, artifact_folder: Path) -> str:
    """The URL given, else that of a SQLite file in the artifact folder."""
    return database_url or f"sqlite:///{artifact_folder.resolve() / SQLITE_FILE}"


class JobDatabase:
    """A connection to the queue, its tables made where they are missing. Free for use from several threads."""

    def __init__(self, artifact_folder: Path, database_url: str | None) -> None:
        """Raises StartupFailed where the database cannot be reached."""
        self.url = database_url_or_default(database_url, artifact_folder)
        quiet_dbos()
        try:
            artifact_folder.mkdir(parents=True, exist_ok=True)
            DBOS.migrate(self.url)
            self.client = DBOSClient(system_database_url=self.url, application_name=APPLICATION, serializer=SERIALIZER)
        except (SQLAlchemyError, OSError, ValueError, ImportError) as error:
            raise StartupFailed(
                f"the database of the jobs cannot be opened ({_without_password(self.url)}): "
                f"{str(error).splitlines()[0]}; set ULTRAGRAY_DATABASE_URL, or leave it out for a SQLite file",
                field="database_url",
            ) from error

    @property
    def engine(self) -> sa.Engine:
        """For tables of our own beside those of the queue."""
        engine: sa.Engine = self.client._sys_db.engine
        return engine

    def enqueue(self, options: EnqueueOptions, *arguments: Any) -> None:
        """Puts a workflow into the queue behind all others of its priority.

        DBOS orders by the time of submission, which on SQLite it may know to the second only: here it is set to the
        millisecond, and after that of every other job.
        """
        rows = self.client._sys_db.tables.workflow_status
        with self.engine.begin() as connection:
            self.client.enqueue_in_transaction(connection, options, *arguments)
            last_ms = sa.select(sa.func.coalesce(sa.func.max(rows.c.created_at), 0)).where(
                rows.c.workflow_uuid != options["workflow_id"]
            )
            submitted_ms = max(int(time.time() * 1000), 1 + (connection.execute(last_ms).scalar() or 0))
            connection.execute(
                sa.update(rows).where(rows.c.workflow_uuid == options["workflow_id"]).values(created_at=submitted_ms)
            )

    def workflow(self, job_id: str, *, with_output: bool = False) -> WorkflowStatus | None:
        """The queue's row of a job."""
        rows = self.client.list_workflows(workflow_ids=[job_id], load_input=False, load_output=with_output)
        return rows[0] if rows else None

    def unfinished(self) -> list[WorkflowStatus]:
        """The rows of all jobs that wait or run, oldest first."""
        return self.client.list_workflows(
            status=[*QUEUED, *RUNNING], queue_name=QUEUE, load_input=False, load_output=False
        )

    def take_back(self, job_id: str, executor: str) -> bool:
        """Puts a job that `executor` runs back into the queue; False where it does not run it (any more).

        Not `resume_workflow`, which would also revive a job cancelled a moment ago.
        """
        return self.client._sys_db.reenqueue_for_recovery(job_id, [executor], QUEUE)

    def close(self) -> None:
        """Ends the connections."""
        self.client.destroy()


def quiet_dbos() -> None:
    """DBOS tells its warnings through the handlers of the process, and nothing else."""
    logger = logging.getLogger("dbos")
    logger.handlers.clear()
    logger.propagate = True
    logger.setLevel(logging.WARNING)
    logger.addFilter(_is_news)


def _is_news(record: logging.LogRecord) -> bool:
    """Not: that a job failed or is another worker's now. Both are ordinary, and told by us."""
    told = record.getMessage()
    return "Exception encountered in background workflow" not in told and "no longer owned" not in told


def _without_password(url: str) -> str:
    scheme, separator, rest = url.partition("://")
    return f"{scheme}{separator}{rest.rpartition('@')[2]}"


def dbos_config(url: str, executor: str) -> Any:
    """The configuration of a worker's DBOS: pinned version, stable executor, no ports, no telemetry."""
    return {
        "name": APPLICATION,
        "system_database_url": url,
        "application_version": VERSION,
        "executor_id": executor,
        "serializer": SERIALIZER,
        "log_level": "WARNING",
        "enable_otlp": False,
        "run_migrations": False,
    }
