"""The jobs as the service sees them: submitted, listed, watched, cancelled, retried, deleted. Free of torch."""

from __future__ import annotations

import hashlib
import os
import re
import threading
import uuid
from pathlib import Path

from dbos import EnqueueOptions, WorkflowSerializationFormat, WorkflowStatus
from dbos import error as dbos_error

from ultragray.errors import InvalidArgument
from ultragray.image_size import MAX_IMAGE_SIDE

from ..datasets.store import DatasetStore
from ..errors import (
    ArtifactNotFound,
    DatasetNotFound,
    JobConflict,
    JobFinished,
    JobInUse,
    JobNotFinished,
    JobNotFound,
    JobQueueFull,
    SceneExists,
)
from ..scenes import SceneStore
from .folder import JobFolder, Progress
from .job import MAX_PRIORITY, PRIORITY_ZERO, STATUSES, Job, JobState, attribute, job_of_row
from .kinds import Specification
from .publication import SCENES_FOLDER
from .queue import database
from .queue.database import JobDatabase
from .queue.listing import count_by_status, page_of_rows
from .removal import remove_job, sources_in_use
from .requirements import Requirements
from .specification import from_dict, in_short, to_dict, value_in

__all__ = ["SCENES_FOLDER", "Job", "JobState", "JobStore", "Progress"]


MAX_REQUEST_ID_CHARACTERS = 128
_JOB_ID = re.compile(r"[0-9a-f]{24}")
_TAIL_BYTES = 8192


class JobStore:
    """The jobs of an artifact folder. Its methods block; they may be called from any thread."""

    def __init__(
        self,
        artifact_folder: Path,
        database_url: str | None,
        queue_limit: int = 1000,
        *,
        scenes: SceneStore | None = None,
        max_image_side: int = MAX_IMAGE_SIDE,
    ) -> None:
        """`scenes`: those that jobs may need, and whose names they may not make. None: those that jobs made.

        `max_image_side`: of frames, pixels. Raises StartupFailed where the database cannot be reached.
        """
        self._artifact_folder = Path(artifact_folder)
        self._database = JobDatabase(self._artifact_folder, database_url)
        self._queue_limit = queue_limit
        self._requirements = Requirements(
            datasets=DatasetStore(self._artifact_folder),
            scenes=scenes or SceneStore(self._artifact_folder / SCENES_FOLDER),
            artifact_folder=self._artifact_folder,
            max_image_side=max_image_side,
        )
        self._submitting = threading.Lock()  # so that one service keeps the queue limit to the job

    def submit(
        self,
        specification: Specification,
        *,
        request_id: str | None = None,
        priority: int = 0,
    ) -> tuple[Job, bool]:
        """The job, and whether it is new: the same `request_id` gives the same job, whatever became of it.

        Raises JobConflict where that one asked for something else, JobQueueFull, and what `Requirements.provide`
        raises.
        """
        if abs(priority) > MAX_PRIORITY:
            raise InvalidArgument(
                f"priority must be an integer from {-MAX_PRIORITY} to {MAX_PRIORITY}, got {priority}", field="priority"
            )
        job_id = uuid.uuid4().hex[:24] if request_id is None else _id_of_request(request_id)
        return self._submit(job_id, specification, request_id, priority, None)

    def _submit(
        self, job_id: str, specification: Specification, request_id: str | None, priority: int, retry_of: str | None
    ) -> tuple[Job, bool]:
        short = in_short(specification)
        made = value_in(short, "makes_scene")
        with self._submitting:
            if self._database.workflow(job_id) is not None:
                return self._same(job_id, specification, priority), False
            waiting = self._database.unfinished()
            if sum(row.status in database.QUEUED for row in waiting) >= self._queue_limit:
                raise JobQueueFull(f"{self._queue_limit} jobs wait already: try again later, or cancel some")
            before = None if retry_of is None else self._folder(retry_of)
            self._requirements.provide(specification, self._folder(job_id), before)
            options: EnqueueOptions = {
                "workflow_name": specification.kind,
                "queue_name": database.QUEUE,
                "workflow_id": job_id,
                "workflow_id_reuse_policy": "reject",
                "app_version": database.VERSION,
                "priority": PRIORITY_ZERO - priority,
                "attributes": {"request_id": request_id, "retry_of": retry_of, "specification": short},
                "serialization_type": WorkflowSerializationFormat.PORTABLE,
            }
            if made is not None:
                options["deduplication_id"] = f"scene {made}"
            try:
                self._database.enqueue(options, {"specification": to_dict(specification), "retry_of": retry_of})
            except dbos_error.DBOSWorkflowIDInUseError:  # another service was quicker
                return self._same(job_id, specification, priority), False
            except dbos_error.DBOSQueueDeduplicatedError:
                raise SceneExists(
                    f"another job that waits or runs makes the scene {made!r}: choose another name",
                    field=specification.makes_scene,
                ) from None
            try:  # again, now that a deletion of the dataset would see the job: one that came in between has won
                self._requirements.require_dataset(specification)
            except DatasetNotFound:
                self._database.client.cancel_workflow(job_id)
                self._database.client.delete_workflows([job_id])
                raise
        return self.get(job_id), True

    def _same(self, job_id: str, specification: Specification, priority: int) -> Job:
        """The job that is there already. Raises JobConflict where it is asked for something else."""
        row = self._row(job_id, with_input=True)
        job = self._seen(row)
        if priority != job.priority or to_dict(_specification_of(row)) != to_dict(specification):
            raise JobConflict(
                f"the request_id {job.request_id!r} was used for the job {job.id}, which asks for something else",
                field="request_id",
            )
        return job

    def get(self, job_id: str) -> Job:
        """Raises JobNotFound."""
        return self._seen(self._row(job_id))

    def list(
        self,
        *,
        state: JobState | None = None,
        kind: str | None = None,
        page_size: int = 50,
        page_token: str | None = None,
    ) -> tuple[list[Job], str | None]:
        """One page of jobs, newest first, and the token of the next; None on the last.

        Raises InvalidArgument for a token that no page gave.
        """
        statuses = None if state is None else STATUSES[state]
        rows, token = page_of_rows(
            self._database, kind=kind, statuses=statuses, page_size=page_size, page_token=page_token
        )
        return [self._seen(row) for row in rows], token

    def cancel(self, job_id: str) -> Job:
        """Ends a job that waits or runs, its process within a second; nothing where it is cancelled already.

        Raises JobNotFound, and JobFinished for one that succeeded or failed.
        """
        job = self.get(job_id)
        if not job.state.is_final:
            self._database.client.cancel_workflow(job_id)
            job = self.get(job_id)
        if job.state is not JobState.CANCELLED:
            raise JobFinished(f"the job {job_id} has {job.state.value} already", field="job")
        return job

    def retry(self, job_id: str) -> tuple[Job, bool]:
        """The job in place of a failed or cancelled one, and whether it is new: a job has one such successor.

        A training goes on from the last checkpoint of its predecessor. Raises JobNotFound, JobNotFinished, and what
        `submit` raises.
        """
        row = self._row(job_id, with_input=True)
        job = self._seen(row)
        if job.state not in (JobState.FAILED, JobState.CANCELLED):
            raise JobNotFinished(
                f"only a failed or cancelled job can be retried, the job {job_id} is {job.state.value}", field="job"
            )
        return self._submit(_hashed(f"retry {job_id}"), _specification_of(row), None, job.priority, job_id)

    def delete(self, job_id: str) -> None:
        """Removes a finished job and its files; the scene that it made stays.

        Raises JobNotFound, and JobInUse for a job that waits or runs, or that another of those goes on from.
        """
        job = self.get(job_id)
        if not job.state.is_final:
            raise JobInUse(f"the job {job_id} is {job.state.value}: cancel it first", field="job")
        if (successor := sources_in_use(self._database).get(job_id)) is not None:
            raise JobInUse(f"the job {successor} goes on from the job {job_id}", field="job")
        remove_job(self._database, self._folder(job_id))

    def counts(self) -> dict[JobState, int]:
        """The number of jobs in each state."""
        found = count_by_status(self._database)
        return {state: sum(found.get(status, 0) for status in statuses) for state, statuses in STATUSES.items()}

    def log_tail(self, job_id: str, bytes: int = _TAIL_BYTES) -> str:
        """The end of the log of a job's process; empty where there is none yet. Raises JobNotFound."""
        self._row(job_id)
        try:
            with self._folder(job_id).log.open("rb") as file:
                file.seek(max(0, os.fstat(file.fileno()).st_size - bytes))
                return file.read(bytes).decode("utf-8", "replace")
        except FileNotFoundError:
            return ""

    def artifact(self, job_id: str, name: str) -> Path:
        """The file of an artifact. Raises JobNotFound, ArtifactNotFound."""
        job = self.get(job_id)
        path = self._folder(job_id).artifacts / name
        if name not in job.artifacts or not path.is_file():
            known = ", ".join(job.artifacts) or "none"
            raise ArtifactNotFound(f"the job {job_id} has no artifact {name[:128]!r}; it has {known}", field="name")
        return path

    def uses_dataset(self, name: str) -> str | None:
        """The job that needs a dataset, in words; None where no job that waits or runs does."""
        return self._unfinished("needs_dataset", name)

    def makes_scene(self, name: str) -> str | None:
        """The job that will serve a scene of that name, in words; None where no job that waits or runs does."""
        return self._unfinished("makes_scene", name)

    def close(self) -> None:
        """Ends the connections to the database."""
        self._database.close()

    def _unfinished(self, role: str, name: str) -> str | None:
        for row in self._database.unfinished():
            if value_in(attribute(row, "specification"), role) == name:
                return f"the job {row.workflow_id}"
        return None

    def _row(self, job_id: str, *, with_input: bool = False) -> WorkflowStatus:
        row = None
        if _JOB_ID.fullmatch(job_id):
            row = self._database.workflow(job_id, with_input=with_input, with_output=True)
        if row is None:
            raise JobNotFound(f"there is no job {job_id[:64]!r}", field="job")
        return row

    def _seen(self, row: WorkflowStatus) -> Job:
        return job_of_row(row, self._artifact_folder)

    def _folder(self, job_id: str) -> JobFolder:
        return JobFolder(self._artifact_folder, job_id)


def _id_of_request(request_id: str) -> str:
    if not 1 <= len(request_id) <= MAX_REQUEST_ID_CHARACTERS:
        raise InvalidArgument(
            f"request_id must have 1 to {MAX_REQUEST_ID_CHARACTERS} characters, got {len(request_id)}",
            field="request_id",
        )
    return _hashed(f"request {request_id}")


def _hashed(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def _specification_of(row: WorkflowStatus) -> Specification:
    """The specification of a row that was read with its input."""
    assert row.input is not None
    return from_dict(row.input["args"][0]["specification"])
