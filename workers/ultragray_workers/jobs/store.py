"""The jobs as the service sees them: submitted, listed, watched, cancelled, retried, deleted. Free of torch."""

from __future__ import annotations

import hashlib
import json
import re
import threading
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from dbos import EnqueueOptions, WorkflowSerializationFormat, WorkflowStatus
from dbos import error as dbos_error

from ultragray.errors import InvalidArgument
from ultragray.exchange.batches import stands_for
from ultragray.geometry.image_size import MAX_IMAGE_SIDE
from ultragray.geometry.registration import Registration
from ultragray_workers.claims import is_claimed
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import (
    ArtifactNotFound,
    DatasetNotFound,
    JobConflict,
    JobFinished,
    JobInUse,
    JobNotFinished,
    JobQueueFull,
    RegistrationNotFound,
    SceneExists,
    SceneNotFound,
    job_not_found,
)
from ultragray_workers.jobs.files import Artifact, read_log, size_of_log
from ultragray_workers.jobs.folder import JobFolder, Progress
from ultragray_workers.jobs.job import (
    MAX_PRIORITY,
    PRIORITY_ZERO,
    STATUSES,
    Job,
    JobState,
    attribute,
    job_of_row,
    ownership_of,
)
from ultragray_workers.jobs.kinds import Specification
from ultragray_workers.jobs.matching.offer import LivingWorker
from ultragray_workers.jobs.overview import JobsOverview, overview
from ultragray_workers.jobs.places import files_of_jobs
from ultragray_workers.jobs.publication import SCENES_FOLDER, give_name_back
from ultragray_workers.jobs.queue import attendance, database, runs, unfinished
from ultragray_workers.jobs.queue.attendance import Worker
from ultragray_workers.jobs.queue.database import JobDatabase
from ultragray_workers.jobs.queue.internals import MOST_RUNNING
from ultragray_workers.jobs.queue.listing import ids_of_owner, page_of_rows
from ultragray_workers.jobs.queue.owners import (
    NOBODYS,
    Kind,
    Ownership,
    add_owner,
    claim_of_job,
    forget_owner,
    read_owner,
)
from ultragray_workers.jobs.queue.wishes import Wanted
from ultragray_workers.jobs.removal import remove_job
from ultragray_workers.jobs.requirements import Requirements
from ultragray_workers.jobs.shards.shares import batch_of, cancel_shares
from ultragray_workers.jobs.specification import from_dict, in_short, to_dict, value_in
from ultragray_workers.jobs.tracing import TRACE, current_trace
from ultragray_workers.scenes import SceneStore
from ultragray_workers.shared_claims import SharedClaims
from ultragray_workers.storage.storage import Storage
from ultragray_workers.store import OpenStore

__all__ = ["SCENES_FOLDER", "Job", "JobState", "JobStore", "Progress"]


MAX_REQUEST_ID_CHARACTERS = 128
_JOB_ID = re.compile(r"[0-9a-f]{24}")
_STORABLE = re.compile(r"[^\0\ud800-\udfff]*")  # PostgreSQL takes no NUL, and UTF-8 no surrogates
_TAIL_BYTES = 8192
_ASKED_PRIVATE = "asked_private"  # attribute of a job, which is also private where it takes something private
_ASKED_SHA256 = "asked_sha256"  # attribute of a job that a registration led: of what it asked for


Admit = Callable[["JobStore"], int | None]  # raises what keeps a new job out, else: how many may run at once


def _admit_any(jobs: JobStore) -> int | None:
    """Keeps no job out, and has any number of them run."""
    return None


def _no_registration(name: str, _: str) -> Registration:
    raise RegistrationNotFound(f"there is no registration {name!r}", field="registration")


Shown = Callable[[Ownership], bool]  # whether whoever asks may know of a job


def _all_are_shown(_: Ownership) -> bool:
    return True


class JobStore:
    """The jobs of an artifact folder. Its methods block; they may be called from any thread."""

    def __init__(
        self,
        artifact_folder: Path,
        database_url: str | None,
        queue_limit: int = 1000,
        *,
        scenes: SceneStore | None = None,
        datasets: DatasetStore | None = None,
        registration: Callable[[str, str], Registration] = _no_registration,
        shared: Storage | None = None,
        max_image_side: int = MAX_IMAGE_SIDE,
    ) -> None:
        """`scenes`: those that jobs may need, and whose names they may not make. None: those that jobs made.

        `datasets`: those that jobs may need. None: those of the artifact folder.

        `registration`: finds that of a name, for a scene; None is known without it.

        `shared`: the storage in which several hosts have the files of jobs; None: they are in the artifact folder.

        `max_image_side`: of frames, pixels. Raises StartupFailed where the database cannot be reached.
        """
        self._artifact_folder = Path(artifact_folder)
        self._open = OpenStore(self._artifact_folder)
        try:
            self.database = JobDatabase(self._artifact_folder, database_url, shared)
        except BaseException:
            self._open.close()
            raise
        self._queue_limit = queue_limit
        self._shared = shared
        self.files = files_of_jobs(self._artifact_folder, shared)
        self._requirements = Requirements(
            datasets=datasets or DatasetStore(self._artifact_folder, shared),
            scenes=scenes or SceneStore(self._artifact_folder / SCENES_FOLDER),
            registration=registration,
            files=self.files,
            artifact_folder=self._artifact_folder if shared is None else None,
            max_image_side=max_image_side,
        )
        self._submitting = threading.Lock()  # so that one service keeps the queue limit to the job

    def submit(
        self,
        specification: Specification,
        *,
        request_id: str | None = None,
        priority: int = 0,
        owner: str | None = None,
        private: bool = False,
        admit: Admit = _admit_any,
    ) -> tuple[Job, bool]:
        """The job, and whether it is new: the same `request_id` gives the same job, whatever became of it.

        `admit` is called before a new one is made, one at a time: it raises what keeps it out, or tells how many jobs
        of the owner may run at once; None: any number.

        Raises JobConflict where that one asked for something else, JobQueueFull, ArtifactFolderUnavailable, and what
        `Requirements.led` and `Requirements.provide` raise.
        """
        if abs(priority) > MAX_PRIORITY:
            raise InvalidArgument(
                f"priority must be an integer from {-MAX_PRIORITY} to {MAX_PRIORITY}, got {priority}", field="priority"
            )
        if request_id is None:
            job_id = uuid.uuid4().hex[:24]
        else:
            _check_request_id(request_id)
            job_id = self._id_for(f"request {request_id}", owner)
        return self._submit(job_id, specification, priority, owner, private, admit, request_id=request_id)

    def _submit(
        self,
        job_id: str,
        specification: Specification,
        priority: int,
        owner: str | None,
        private: bool,
        admit: Admit,
        *,
        request_id: str | None = None,
        retry_of: str | None = None,
        told: Mapping[str, Any] | None = None,
        by: str | None = None,
    ) -> tuple[Job, bool]:
        """`told`: the specification as jobs tell it, where that of a predecessor was led; None: in short."""
        short, asked = told or in_short(specification), Ownership(owner, private)
        made = value_in(short, "makes_scene")
        self.database.folder.check()
        with self._submitting:
            if self.database.workflow(job_id) is not None:
                return self._same(job_id, specification, priority, asked), False
            if unfinished.count_waiting(self.database) >= self._queue_limit:
                raise JobQueueFull(f"{self._queue_limit} jobs wait already: try again later, or cancel some")
            most_running = admit(self)
            led = self._requirements.led(specification)
            self._requirements.provide(led, job_id, retry_of)
            used = self._requirements.taken(led, retry_of)
            private |= self._are_private(used, owner, by)
            options: EnqueueOptions = {
                "workflow_name": specification.kind,
                "queue_name": database.QUEUE,
                "workflow_id": job_id,
                "workflow_id_reuse_policy": "reject",
                "app_version": database.VERSION,
                "priority": PRIORITY_ZERO - priority,
                "attributes": {
                    "request_id": request_id,
                    "retry_of": retry_of,
                    "specification": short,
                    "private": private,
                    _ASKED_PRIVATE: asked.private,
                    _ASKED_SHA256: None if led is specification else _sha256_of(specification),
                    MOST_RUNNING: most_running,
                    TRACE: current_trace(),
                },
                "serialization_type": WorkflowSerializationFormat.PORTABLE,
            }
            if made is not None:
                options["deduplication_id"] = f"scene {made}"
            if owner is not None:
                options["authenticated_user"] = owner

            def claim_scene(connection: sa.Connection) -> None:
                if made is None or owner is None:
                    return
                if not add_owner(connection, Kind.SCENE, made, Ownership(owner, private, claim_of_job(job_id))):
                    raise SceneExists(
                        f"a scene {made!r} is being imported: choose another name", field=specification.makes_scene
                    )

            if made is not None:
                self._forget_dead_claim(made)
            try:
                self.database.enqueue(
                    options,
                    {"specification": to_dict(led), "retry_of": retry_of, "submission": uuid.uuid4().hex},
                    also=claim_scene,
                )
            except dbos_error.DBOSWorkflowIDInUseError:  # another service was quicker
                return self._same(job_id, specification, priority, asked), False
            except dbos_error.DBOSQueueDeduplicatedError:
                raise SceneExists(
                    f"another job that waits or runs makes the scene {made!r}: choose another name",
                    field=specification.makes_scene,
                ) from None
            try:  # again, now that a deletion of the dataset would see the job: one that came in between has won
                self._requirements.require_dataset(specification)
                self._are_private(used, owner, by)
            except (DatasetNotFound, SceneNotFound):
                self.database.client.cancel_workflow(job_id)
                self.database.client.delete_workflows([job_id])
                if made is not None:
                    give_name_back(self.database, self._folder(job_id), made, owner, self._shared)
                raise
        return self.get(job_id), True

    def _are_private(self, used: list[tuple[Kind, str]], owner: str | None, by: str | None) -> bool:
        """Whether any of the datasets and scenes that a job takes is private.

        Raises DatasetNotFound, SceneNotFound where somebody else asks for the job whose owner may not see one.
        """
        with self.database.engine.connect() as connection:
            whose = [(kind, name, read_owner(connection, kind, name)) for kind, name in used]
        for kind, name, holder in whose:
            if by not in (None, owner) and holder.private and holder.owner != owner:
                not_found = DatasetNotFound if kind is Kind.DATASET else SceneNotFound
                raise not_found(
                    f"the owner of the job may not see the {kind.value} {name!r}: it is private", field=kind.value
                )
        return any(holder.private for _, _, holder in whose)

    def _same(self, job_id: str, specification: Specification, priority: int, asked: Ownership) -> Job:
        """The job that is there already. Raises JobConflict where it asks for something else, or is somebody else's."""
        row = self._row(job_id, with_input=True)
        job = self._seen(row)
        if job.owner is not None and job.owner != asked.owner:
            raise JobConflict(f"the request_id {job.request_id!r} was used already: choose another", field="request_id")
        before = attribute(row, _ASKED_PRIVATE)
        is_same = (priority, asked.private) == (job.priority, job.private if before is None else before)
        if (led := attribute(row, _ASKED_SHA256)) is not None:
            is_same &= led == _sha256_of(specification)
        else:
            is_same &= to_dict(_specification_of(row)) == to_dict(specification)
        if not is_same:
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
        shown: Shown = _all_are_shown,
        page_size: int = 50,
        page_token: str | None = None,
    ) -> tuple[list[Job], str | None]:
        """One page of jobs, newest first, and the token of the next; None on the last.

        Raises InvalidArgument for a token that no page gave.
        """
        statuses = None if state is None else STATUSES[state]
        rows, token = page_of_rows(
            self.database,
            kind=kind,
            statuses=statuses,
            shown=lambda row: shown(ownership_of(row)),
            page_size=page_size,
            page_token=page_token,
        )
        workers = self._workers_for(rows)
        return [job_of_row(row, self.files, workers) for row in rows], token

    def ownership(self, job_id: str) -> Ownership:
        """Whose a job is. Raises JobNotFound."""
        return ownership_of(self._row(job_id, with_output=False))

    def cancel(self, job_id: str) -> Job:
        """Ends a job that waits or runs, its process within a second; nothing where it is cancelled already.

        Raises JobNotFound, and JobFinished for one that succeeded or failed.
        """
        job = self.get(job_id)
        if not job.state.is_final:
            if not runs.decide(self.database.engine, job_id, runs.CANCELLED):
                raise JobFinished(f"the scene of the job {job_id} is being served: it is as good as done", field="job")
            self.database.client.cancel_workflow(job_id)
            cancel_shares(self.database, job_id)
            job = self.get(job_id)
        if job.state is not JobState.CANCELLED:
            raise JobFinished(f"the job {job_id} has {job.state.value} already", field="job")
        made = value_in({**job.specification, "kind": job.kind}, "makes_scene")
        if made is not None:
            give_name_back(self.database, self._folder(job_id), made, job.owner, self._shared)
        return job

    def retry(self, job_id: str, *, by: str | None = None, admit: Admit = _admit_any) -> tuple[Job, bool]:
        """The job in place of a failed or cancelled one, and whether it is new: a job has one such successor.

        `by`: who asks for it; None: the owner of the job. A training goes on from the last checkpoint of its
        predecessor. Raises JobNotFound, JobNotFinished, and what `submit` raises.
        """
        row = self._row(job_id, with_input=True)
        job = self._seen(row)
        if job.state not in (JobState.FAILED, JobState.CANCELLED):
            raise JobNotFinished(
                f"only a failed or cancelled job can be retried, the job {job_id} is {job.state.value}", field="job"
            )
        return self._submit(
            self._id_for(f"retry {job_id}", job.owner),
            _specification_of(row),
            job.priority,
            job.owner,
            job.private,
            admit,
            retry_of=job_id,
            told={"kind": job.kind, **job.specification},
            by=by,
        )

    def delete(self, job_id: str) -> None:
        """Removes a finished job and its files; the scene that it made stays.

        Raises JobNotFound, and JobInUse for a job that waits or runs, or that another of those goes on from.
        """
        job = self.get(job_id)
        if not job.state.is_final:
            raise JobInUse(f"the job {job_id} is {job.state.value}: cancel it first", field="job")
        if (successor := unfinished.successor(self.database, job_id)) is not None:
            raise JobInUse(f"the job {successor} goes on from the job {job_id}", field="job")
        remove_job(self.database, self.files, job_id)

    def overview(self) -> JobsOverview:
        """The jobs in numbers."""
        return overview(self.database)

    def unfinished_of(self, owner: str) -> int:
        """The number of an owner's jobs that wait or run."""
        return unfinished.count_of_owner(self.database, owner)

    def usage_s(self, owner: str | None, since: datetime) -> dict[str, float]:
        """How long the jobs of an owner ran since the day of `since` (UTC), s, by device: cpu, gpu."""
        return runs.usage_s(self.database.engine, owner, since)

    def artifact_files_of(self, owner: str) -> Iterator[Artifact]:
        """The files that can be downloaded of an owner's jobs."""
        for job_id in ids_of_owner(self.database, owner):
            yield from self.files.artifacts(job_id).values()

    def log_tail(self, job_id: str, bytes: int = _TAIL_BYTES) -> str:
        """The end of the log of a job's process; empty where there is none yet. Raises JobNotFound."""
        self._row(job_id)
        log = self.files.log(job_id)
        return read_log(log, max(0, size_of_log(log) - bytes), bytes).decode("utf-8", "replace")

    def artifact(self, job_id: str, name: str) -> Artifact:
        """The file of an artifact. Raises JobNotFound, ArtifactNotFound."""
        job = self.get(job_id)
        found = None
        if any(stands_for(one, name) for one in job.artifacts):
            found = self.files.artifact(job_id, name)
        if found is None:
            known = ", ".join(job.artifacts) or "none"
            raise ArtifactNotFound(f"the job {job_id} has no artifact {name[:128]!r}; it has {known}", field="name")
        return found

    def workers(self, shown: Shown = _all_are_shown) -> tuple[Worker, ...]:
        """The workers of the queue, by name; a job at hand that is not `shown`, or gone again, is left out."""

        def told(worker: Worker) -> Worker:
            job = None if worker.job is None else batch_of(worker.job)
            row = None if job is None else self.database.workflow(job)
            return replace(worker, job=job if row is not None and shown(ownership_of(row)) else None)

        return tuple(map(told, attendance.list_workers(self.database)))

    def want(self, worker: str, wanted: Wanted) -> Worker:
        """The worker, which is told what is wanted of it. Raises WorkerNotFound."""
        return attendance.want(self.database, worker, wanted)

    def uses_dataset(self, name: str, shown: Shown = _all_are_shown) -> str | None:
        """The job that needs a dataset, in words; None where no job that waits or runs does."""
        return self._unfinished("needs_dataset", name, shown)

    def makes_scene(self, name: str, shown: Shown = _all_are_shown) -> str | None:
        """The job that will serve a scene of that name, in words; None where no job that waits or runs does."""
        return self._unfinished("makes_scene", name, shown)

    def close(self) -> None:
        """Ends the connections to the database; the folder may be restored."""
        self.database.close()
        self._open.close()

    def _forget_dead_claim(self, scene: str) -> None:
        """Forgets whose a scene was to be that nobody makes any more, such as an import of a service that died."""
        with self.database.engine.begin() as connection:
            holder = read_owner(connection, Kind.SCENE, scene)
        if holder == NOBODYS or self._is_claimed(str(holder.claim)):
            return
        if self.makes_scene(scene) is None and scene not in self._requirements.scenes.names():
            with self.database.engine.begin() as connection:
                forget_owner(connection, Kind.SCENE, scene, holder)

    def _is_claimed(self, claim: str) -> bool:
        """Whether a service that lives imports the scene of a claim."""
        if is_claimed(self._artifact_folder / SCENES_FOLDER / claim):
            return True
        return self._shared is not None and SharedClaims(self._shared).is_claimed(claim)

    def _unfinished(self, role: str, name: str, shown: Shown) -> str | None:
        job_id = unfinished.naming(self.database, role, name)
        if job_id is None:
            return None
        row = self.database.workflow(job_id)
        return f"the job {job_id}" if row is not None and shown(ownership_of(row)) else "a private job of somebody else"

    def _id_for(self, text: str, owner: str | None) -> str:
        """The id of the one job of an owner that a text without NUL stands for."""
        ownerless = _hashed(text)  # also that of the jobs of releases whose ids did not tell owners apart
        if owner is None:
            return ownerless
        row = self.database.workflow(ownerless)
        is_mine = row is not None and row.authenticated_user in (None, owner)
        return ownerless if is_mine else _hashed(f"{text}\0{owner}")

    def _row(self, job_id: str, *, with_input: bool = False, with_output: bool = True) -> WorkflowStatus:
        row = None
        if _JOB_ID.fullmatch(job_id):
            row = self.database.workflow(job_id, with_input=with_input, with_output=with_output)
        if row is None:
            raise job_not_found(job_id)
        return row

    def _seen(self, row: WorkflowStatus) -> Job:
        return job_of_row(row, self.files, self._workers_for([row]))

    def _workers_for(self, rows: Sequence[WorkflowStatus]) -> Sequence[LivingWorker]:
        """The workers that live, if any of the jobs waits for one."""
        is_asked = any(row.status in database.QUEUED for row in rows)
        return attendance.living_workers(self.database) if is_asked else ()

    def _folder(self, job_id: str) -> JobFolder:
        return JobFolder(self._artifact_folder, job_id)


def _check_request_id(request_id: str) -> None:
    if not 1 <= len(request_id) <= MAX_REQUEST_ID_CHARACTERS:
        raise InvalidArgument(
            f"request_id must have 1 to {MAX_REQUEST_ID_CHARACTERS} characters, got {len(request_id)}",
            field="request_id",
        )
    if not _STORABLE.fullmatch(request_id):
        raise InvalidArgument(
            "request_id must be text without NUL and without halves of characters", field="request_id"
        )


def _sha256_of(specification: Specification) -> str:
    return hashlib.sha256(json.dumps(to_dict(specification)).encode()).hexdigest()


def _hashed(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def _specification_of(row: WorkflowStatus) -> Specification:
    """The specification of a row that was read with its input."""
    assert row.input is not None
    return from_dict(row.input["args"][0]["specification"])
