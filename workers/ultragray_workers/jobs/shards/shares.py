"""Shares of batches in the queue: tasks by which more workers come to a batch. Users see the batch only."""

from __future__ import annotations

import uuid
from typing import Any

import sqlalchemy as sa
from dbos import EnqueueOptions, WorkflowSerializationFormat, WorkflowStatus
from dbos import error as dbos_error

from ultragray_workers.jobs.queue import database, runs
from ultragray_workers.jobs.queue.database import JobDatabase
from ultragray_workers.jobs.queue.internals import WORKFLOWS

SHARE = "share"  # the name of its workflow
SHARE_OF = "share_of"  # in its request: the batch
_ROWS = WORKFLOWS.c
_UNFINISHED = (*database.QUEUED, *database.RUNNING)


def batch_of(job_id: str) -> str:
    """The batch of a share; of any other job, itself."""
    return job_id.partition("-")[0]


def call_help(jobs: JobDatabase, batch: WorkflowStatus, request: dict[str, Any]) -> None:
    """Puts a share of a batch into the queue, unless one waits there.

    `request`: what the workflow of the batch was given.
    """
    with jobs.engine.connect() as connection:
        waiting = sa.select(_ROWS.workflow_uuid).where(*_of(batch.workflow_id), _ROWS.status.in_(database.QUEUED))
        if connection.execute(waiting.limit(1)).first() is not None:
            return
    share = f"{batch.workflow_id}-{uuid.uuid4().hex[:8]}"
    options: EnqueueOptions = {
        "workflow_name": SHARE,
        "queue_name": database.QUEUE,
        "workflow_id": share,
        "app_version": database.VERSION,
        "attributes": dict(batch.attributes or {}),
        "serialization_type": WorkflowSerializationFormat.PORTABLE,
    }
    if batch.priority is not None:
        options["priority"] = batch.priority
    if batch.authenticated_user is not None:
        options["authenticated_user"] = batch.authenticated_user
    try:
        jobs.enqueue(options, {**request, SHARE_OF: batch.workflow_id})
    except dbos_error.DBOSWorkflowIDInUseError:
        return


def cancel_shares(jobs: JobDatabase, batch: str) -> None:
    """Ends the shares of a batch that is over: those that wait, and those that run within a second."""
    with jobs.engine.connect() as connection:
        found = sa.select(_ROWS.workflow_uuid).where(*_of(batch), _ROWS.status.in_(_UNFINISHED))
        left = list(connection.execute(found).scalars())
    for share in left:
        jobs.client.cancel_workflow(share)


def forget_shares(jobs: JobDatabase, batch: str) -> list[str]:
    """Removes the rows of the shares of a batch; their ids."""
    with jobs.engine.connect() as connection:
        shares = list(connection.execute(sa.select(_ROWS.workflow_uuid).where(*_of(batch))).scalars())
    if shares:
        jobs.client.delete_workflows(shares)
        with jobs.engine.begin() as connection:
            for share in shares:
                runs.forget(connection, share)
    return shares


def _of(batch: str) -> tuple[sa.ColumnElement[bool], ...]:
    """Of the shares of a batch, whose ids begin with its own: by the index of ids."""
    return _ROWS.workflow_uuid > f"{batch}-", _ROWS.workflow_uuid < f"{batch}.", _ROWS.name == SHARE
