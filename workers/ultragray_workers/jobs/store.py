"""The jobs as the service sees them: submitted, listed, watched, cancelled, retried, deleted. Free of torch.

`submit` checks what the job needs and writes its row; the workers take it from there. All that is
told of a job is its row (`jobs.record`) and the objects that the row names (`jobs.files`).
"""

from __future__ import annotations

import builtins
import hashlib
import json
import re
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from opentelemetry import propagate

from ultragray.errors import InvalidArgument
from ultragray.exchange.batches import stands_for
from ultragray.geometry.image_size import MAX_IMAGE_SIDE
from ultragray.geometry.registration import Registration
from ultragray.scene.info import read_header
from ultragray_workers.claims import storage_full
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
from ultragray_workers.jobs import queue, workers
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.demand import AUTO, CPU, CUDA, Demand, waits_for
from ultragray_workers.jobs.files import Artifact, JobFiles
from ultragray_workers.jobs.kinds import Specification
from ultragray_workers.jobs.kinds.base import Surroundings, carried_name, from_dict, in_short, to_dict, value_in
from ultragray_workers.jobs.owners import (
    NOBODYS,
    Kind,
    Ownership,
    add_owner,
    claim_of_job,
    forget_owner,
    read_owner,
)
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.record import MAX_PRIORITY, Job, Row, job_of
from ultragray_workers.jobs.workers import Wanted, Worker, WorkerState
from ultragray_workers.scene_names import base_name
from ultragray_workers.scene_shelf import SCENES_FOLDER
from ultragray_workers.scenes import SceneStore
from ultragray_workers.storage.local import LocalStorage
from ultragray_workers.storage.storage import Storage
from ultragray_workers.store import OpenStore

MAX_REQUEST_ID_CHARACTERS = 128
_JOB_ID = re.compile(r"[0-9a-f]{24}")
_STORABLE = re.compile(r"[^\0\ud800-\udfff]*")  # PostgreSQL takes no NUL, and UTF-8 no surrogates
_TAIL_BYTES = 8192

Admit = Callable[["JobStore"], int | None]  # raises what keeps a new job out, else: how many may run at once
Shown = Callable[[Ownership], bool]  # whether whoever asks may know of a job


def _admit_any(jobs: JobStore) -> int | None:
    return None


def _no_registration(name: str, _: str) -> Registration:
    raise RegistrationNotFound(f"there is no registration {name!r}", field="registration")


def _all_are_shown(_: Ownership) -> bool:
    return True


@dataclass(frozen=True)
class JobsOverview:
    """How many jobs and workers there are in each state, and which jobs wait. Empty where it is not known."""

    counts: Mapping[JobState, int] = field(default_factory=dict)
    workers: Mapping[WorkerState, int] = field(default_factory=dict)
    # By the device that jobs ask for (auto, cpu, cuda): how long the one has waited that waits longest; 0: none waits.
    oldest_waiting_s: Mapping[str, float] = field(default_factory=dict)
    unfit: int = 0  # jobs that wait for a worker that is not there


class JobStore:
    """The jobs of a database and a storage. Its methods block; they may be called from any thread."""

    def __init__(
        self,
        artifact_folder: Path,
        database_url: str | None,
        queue_limit: int = 1000,
        *,
        scenes: SceneStore | None = None,
        datasets: DatasetStore | None = None,
        registration: Callable[[str, str], Registration] = _no_registration,
        storage: Storage | None = None,
        max_image_side: int = MAX_IMAGE_SIDE,
    ) -> None:
        """`scenes`: those that jobs may need, and whose names they may not make. None: those that jobs made.

        `datasets`: those that jobs may need. None: those of the storage.

        `registration`: finds that of a name, for a scene; None is known without it.

        `storage`: of the files of jobs; None: the artifact folder.

        `max_image_side`: of frames, pixels. Raises StartupFailed where the database cannot be reached.
        """
        self._artifact_folder = Path(artifact_folder)
        self._storage = storage or LocalStorage(self._artifact_folder)
        self._open = OpenStore(self._artifact_folder)
        try:
            self.database = JobDatabase(self._artifact_folder, database_url, self._storage)
        except BaseException:
            self._open.close()
            raise
        self._engine = self.database.engine
        self._queue_limit = queue_limit
        self.files = JobFiles(self._storage, lambda job_id: queue.row_of(self._engine, job_id), self._artifact_folder)
        self._datasets = datasets or DatasetStore(self._artifact_folder, self._storage)
        self._scenes = scenes or SceneStore(self._artifact_folder / SCENES_FOLDER)
        self._registration, self._max_image_side = registration, max_image_side
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

        Raises JobConflict where that one asked for something else, JobQueueFull, ArtifactFolderUnavailable,
        DatasetNotFound, DatasetInvalid, SceneExists, SceneNotFound, SceneFileInvalid, RegistrationNotFound,
        StorageFull, StorageUnavailable, and what `check` of the specification raises.
        """
        if abs(priority) > MAX_PRIORITY:
            raise InvalidArgument(
                f"priority must be an integer from {-MAX_PRIORITY} to {MAX_PRIORITY}, got {priority}", field="priority"
            )
        job_id = uuid.uuid4().hex[:24] if request_id is None else _id_of(f"request {request_id}", owner)
        if request_id is not None:
            _check_request_id(request_id)
        summary, whose = in_short(specification), Ownership(owner, private)
        return self._submit(job_id, specification, summary, priority, whose, admit, request_id=request_id)

    def _submit(
        self,
        job_id: str,
        specification: Specification,
        summary: dict[str, Any],  # as jobs tell it: before a registration brought its poses into the scene
        priority: int,
        whose: Ownership,  # as it was asked; a job is also private where it takes something private
        admit: Admit,
        *,
        request_id: str | None = None,
        retry_of: str | None = None,
        by: str | None = None,  # who asks; None: the owner
    ) -> tuple[Job, bool]:
        owner = whose.owner
        self.database.identity.check()
        text = json.dumps([_plain(to_dict(specification)), priority, whose.private], sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()  # the same request_id must ask for the same
        with self._submitting:
            if queue.row_of(self._engine, job_id) is not None:
                return self._same(job_id, digest), False
            if queue.count_waiting(self._engine) >= self._queue_limit:
                raise JobQueueFull(f"{self._queue_limit} jobs wait already: try again later, or cancel some")
            most_running = admit(self)
            placed = self._placed(specification)
            used = self._provide(placed, job_id, retry_of)
            self._keep_carried(placed, carried_name(summary), job_id, retry_of)
            is_private = whose.private | self._are_private(used, owner, by)
            scene_name = value_in(summary, "makes_scene")
            trace: dict[str, str] = {}
            propagate.inject(trace)
            values = {
                "id": job_id,
                "kind": specification.kind,
                "priority": priority,
                "owner": owner,
                "private": is_private,
                "request_id": request_id,
                "asked": digest,
                "retry_of": retry_of,
                "summary": summary,
                "specification": to_dict(placed),
                "dataset": value_in(summary, "needs_dataset"),
                "makes_scene": scene_name,
                "demand": Demand.of(summary).key,
                "most_running": most_running,
                "trace": trace,
            }

            def claim_scene(connection: sa.Connection) -> None:
                if scene_name is None or owner is None:
                    return
                ownership = Ownership(owner, is_private, claim_of_job(job_id))
                if not add_owner(connection, Kind.SCENE, scene_name, ownership):
                    holder = read_owner(connection, Kind.SCENE, scene_name)
                    if retry_of is not None and holder == replace(ownership, claim=claim_of_job(retry_of)):
                        forget_owner(connection, Kind.SCENE, scene_name, holder)
                        add_owner(connection, Kind.SCENE, scene_name, ownership)
                        return
                    raise SceneExists(
                        f"a scene {scene_name!r} is being imported: choose another name",
                        field=specification.makes_scene,
                    )

            if scene_name is not None:
                self._forget_dead_claim(scene_name)
            try:
                if not queue.submit(self._engine, values, claim_scene):  # another service was quicker
                    return self._same(job_id, digest), False
            except queue.SceneTaken:
                raise SceneExists(
                    f"another job that waits or runs makes the scene {scene_name!r}: choose another name",
                    field=specification.makes_scene,
                ) from None
            try:  # again, now that a deletion of the dataset would see the job: one that came in between has won
                if (dataset := _named(placed, placed.needs_dataset)) is not None:
                    self._require_dataset(placed, dataset)
                self._are_private(used, owner, by)
            except (DatasetNotFound, SceneNotFound):
                queue.cancel(self._engine, job_id)
                queue.forget(self._engine, job_id)
                raise
        return self.get(job_id), True

    def _placed(self, specification: Specification) -> Specification:
        """The job with its poses brought into its scene by the registration that it names, as that is now.

        Raises SceneNotFound, RegistrationNotFound, and InvalidArgument for one of another scene.
        """
        name = _named(specification, specification.needs_registration)
        if name is None:
            return specification
        scene = _named(specification, specification.needs_scene)
        self._scenes.path(scene)
        return specification.registered(self._registration(name, scene))

    def _provide(self, specification: Specification, job_id: str, before: str | None) -> list[tuple[Kind, str]]:
        """Keeps the scene that the job needs, as it is now, for the job, once the job can be done.

        `before`: the job that it replaces, whose scene is taken where it is still there. Returns the dataset and the
        scene that the job takes, but for a scene that the job before has kept.
        """
        inputs = []
        if (dataset := _named(specification, specification.needs_dataset)) is not None:
            self._require_dataset(specification, dataset)
            inputs.append((Kind.DATASET, dataset))
        scene_name = _named(specification, specification.makes_scene)
        goes_on = before is not None and specification.serves_versions  # with the scene that it has served already
        if scene_name is not None and not goes_on and scene_name in self._scenes.names():
            raise SceneExists(
                f"there is already a scene {scene_name!r}: choose another name", field=specification.makes_scene
            )
        free_bytes, name = self._storage.free_bytes(), _named(specification, specification.needs_scene)
        if name is None:
            specification.check(Surroundings(None, free_bytes, self._max_image_side))
            return inputs
        with nullcontext() if before is None else self.files.kept_scene(before, name) as file:
            path = self._scenes.path(name) if file is None else file
            header = self._scenes.header(name) if file is None else read_header(file)
            with storage_full("the scene of the job"):
                specification.check(Surroundings(header, free_bytes, self._max_image_side))
                try:
                    self.files.keep_scene(path, name, job_id)
                except FileNotFoundError:
                    self._scenes.path(name)  # raises SceneNotFound where the scene has just gone
                    raise
        return inputs if file is not None else [*inputs, (Kind.SCENE, base_name(name))]

    def _keep_carried(self, specification: Specification, name: str | None, job_id: str, before: str | None) -> None:
        """Keeps the file that comes with the job, or came with the job before, for the job. Raises InvalidArgument."""
        if name is None:
            return
        with storage_full("the file of the job"):
            if before is None:
                self.files.keep_carried(name, specification.carried_content(), job_id)
            else:
                self.files.keep_carried_again(name, before, job_id)

    def _require_dataset(self, specification: Specification, dataset: str) -> None:
        """Raises DatasetNotFound, DatasetInvalid."""
        if specification.takes_recordings:
            self._datasets.require(dataset)
        else:
            self._datasets.get(dataset)

    def _are_private(self, used: list[tuple[Kind, str]], owner: str | None, by: str | None) -> bool:
        """Whether any of the datasets and scenes that a job takes is private.

        Raises DatasetNotFound, SceneNotFound where somebody else asks for the job whose owner may not see one.
        """
        with self._engine.connect() as connection:
            whose = [(kind, name, read_owner(connection, kind, name)) for kind, name in used]
        for kind, name, holder in whose:
            if by not in (None, owner) and holder.private and holder.owner != owner:
                not_found = DatasetNotFound if kind is Kind.DATASET else SceneNotFound
                raise not_found(
                    f"the owner of the job may not see the {kind.value} {name!r}: it is private", field=kind.value
                )
        return any(holder.private for _, _, holder in whose)

    def _same(self, job_id: str, digest: str) -> Job:
        """The job that is there already. Raises JobConflict where it asks for something else."""
        row = self._row(job_id)
        if row.asked != digest:
            raise JobConflict(
                f"the request_id {row.request_id!r} was used for the job {row.id}, which asks for something else",
                field="request_id",
            )
        return self._job(row)

    def get(self, job_id: str) -> Job:
        return self._job(self._row(job_id))

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
        rows, token = queue.page(
            self._engine,
            state=state,
            kind=kind,
            shown=lambda row: shown(row.ownership),
            page_size=page_size,
            page_token=page_token,
        )
        return self._jobs(rows), token

    def ownership(self, job_id: str) -> Ownership:
        return self._row(job_id).ownership

    def cancel(self, job_id: str) -> Job:
        """Ends a job that waits or runs, its process within a second; nothing where it is cancelled already.

        Raises JobNotFound, and JobFinished for one that succeeded or failed.
        """
        self._row(job_id)
        queue.cancel(self._engine, job_id)
        job = self.get(job_id)
        if not job.state.is_final:
            raise JobFinished(f"the scene of the job {job_id} is being served: it is as good as done", field="job")
        if job.state is not JobState.CANCELLED:
            raise JobFinished(f"the job {job_id} has {job.state.value} already", field="job")
        return job

    def retry(self, job_id: str, *, by: str | None = None, admit: Admit = _admit_any) -> tuple[Job, bool]:
        """The job in place of a failed or cancelled one, and whether it is new: a job has one such successor.

        `by`: who asks for it; None: the owner of the job. A training goes on from the last checkpoint of its
        predecessor. Raises JobNotFound, JobNotFinished, and what `submit` raises.
        """
        row = self._row(job_id)
        if row.state not in (JobState.FAILED, JobState.CANCELLED):
            raise JobNotFinished(
                f"only a failed or cancelled job can be retried, the job {job_id} is {row.state.value}", field="job"
            )
        specification = from_dict(queue.specification_of(self._engine, job_id))
        new_id = _id_of(f"retry {job_id}", row.owner)
        return self._submit(
            new_id, specification, row.summary, row.priority, row.ownership, admit, retry_of=job_id, by=by
        )

    def delete(self, job_id: str) -> None:
        """Removes a finished job and its files; the scene that it made stays.

        Raises JobNotFound, and JobInUse for a job that waits or runs, or that another of those goes on from.
        """
        row = self._row(job_id)
        if not row.state.is_final:
            raise JobInUse(f"the job {job_id} is {row.state.value}: cancel it first", field="job")
        if (successor := queue.successor(self._engine, job_id)) is not None:
            raise JobInUse(f"the job {successor} goes on from the job {job_id}", field="job")
        self.files.remove(job_id)  # first, so that no other job can have the id before the files are gone
        queue.forget(self._engine, job_id)

    def overview(self) -> JobsOverview:
        counts = queue.count_by_state(self._engine)
        states = [worker.state for worker in workers.list_workers(self._engine)]
        oldest_s, unfit, now_s = dict.fromkeys((AUTO, CPU, CUDA), 0.0), 0, time.time()
        living = workers.living_workers(self._engine)
        for demand, count, oldest_ms in queue.waiting(self._engine):
            kind = demand.device.partition(":")[0]
            oldest_s[kind] = max(oldest_s[kind], now_s - oldest_ms / 1000.0)
            unfit += count if waits_for(demand, living) is not None else 0
        return JobsOverview(
            counts={state: counts.get(state, 0) for state in JobState},
            workers={state: states.count(state) for state in WorkerState},
            oldest_waiting_s=oldest_s,
            unfit=unfit,
        )

    def unfinished_of(self, owner: str) -> int:
        return queue.count_of_owner(self._engine, owner)

    def usage_s(self, owner: str | None, since: datetime) -> dict[str, float]:
        """How long the jobs of an owner ran since the day of `since` (UTC), s, by device: cpu, gpu."""
        return queue.usage_s(self._engine, owner, since)

    def artifact_files_of(self, owner: str) -> Iterator[Artifact]:
        """The files that can be downloaded of an owner's jobs."""
        for job_id in queue.ids_of_owner(self._engine, owner):
            yield from self.files.artifacts(job_id).values()

    def log_tail(self, job_id: str, bytes: int = _TAIL_BYTES) -> str:
        """The end of the log of a job's process; empty where there is none yet. Raises JobNotFound."""
        self._row(job_id)
        log = self.files.log(job_id)
        return log.read(max(0, log.size() - bytes), bytes).decode("utf-8", "replace")

    def artifact(self, job_id: str, name: str) -> Artifact:
        """The file of an artifact. Raises JobNotFound, ArtifactNotFound."""
        job = self.get(job_id)
        artifact = None
        if any(stands_for(one, name) for one in job.artifacts):
            artifact = self.files.artifact(job_id, name)
        if artifact is None:
            known = ", ".join(job.artifacts) or "none"
            raise ArtifactNotFound(f"the job {job_id} has no artifact {name[:128]!r}; it has {known}", field="name")
        return artifact

    def workers(self, shown: Shown = _all_are_shown) -> tuple[Worker, ...]:
        """The workers of the queue, by name; a job at hand that is not `shown`, or gone again, is left out."""

        def seen(worker: Worker) -> Worker:
            row = None if worker.job is None else queue.row_of(self._engine, worker.job)
            is_shown = row is not None and shown(row.ownership)
            return replace(worker, job=(row.batch or row.id) if row is not None and is_shown else None)

        return tuple(map(seen, workers.list_workers(self._engine)))

    def want(self, worker: str, wanted: Wanted) -> Worker:
        """The worker, which is told what is wanted of it. Raises WorkerNotFound."""
        return workers.want(self._engine, worker, wanted)

    def uses_dataset(self, name: str, shown: Shown = _all_are_shown) -> str | None:
        """The job that needs a dataset, in words; None where no job that waits or runs does."""
        return _in_words(queue.find(self._engine, needs_dataset=name), shown)

    def makes_scene(self, name: str, shown: Shown = _all_are_shown) -> str | None:
        """The job that will serve a scene of that name, in words; None where no job that waits or runs does."""
        return _in_words(queue.find(self._engine, makes_scene=name), shown)

    def close(self) -> None:
        self.database.close()
        self._open.close()

    def _forget_dead_claim(self, scene: str) -> None:
        """Forgets whose a scene was to be that nobody makes any more, such as an import of a service that died."""
        with self._engine.connect() as connection:
            holder = read_owner(connection, Kind.SCENE, scene)
        if holder == NOBODYS or self._storage.is_claimed(str(holder.claim)):
            return
        if self.makes_scene(scene) is None and scene not in self._scenes.names():
            with self._engine.begin() as connection:
                forget_owner(connection, Kind.SCENE, scene, holder)

    def _row(self, job_id: str) -> Row:
        row = queue.row_of(self._engine, job_id) if _JOB_ID.fullmatch(job_id) else None
        if row is None:
            raise job_not_found(job_id)
        return row

    def _job(self, row: Row) -> Job:
        return self._jobs([row])[0]

    def _jobs(self, rows: Sequence[Row]) -> builtins.list[Job]:
        waits = any(row.state is JobState.QUEUED for row in rows)
        living = workers.living_workers(self._engine) if waits else ()
        return [job_of(row, living) for row in rows]


def _in_words(row: Row | None, shown: Shown) -> str | None:
    if row is None:
        return None
    return f"the job {row.id}" if shown(row.ownership) else "a private job of somebody else"


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


def _plain(value: Any) -> Any:
    """A value of JSON as every door writes it: 2.0 and 2 are the same."""
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _id_of(text: str, owner: str | None) -> str:
    """The id of the one job of an owner that a text without NUL stands for."""
    key = text if owner is None else f"{text}\0{owner}"
    return hashlib.sha256(key.encode("utf-8", "surrogatepass")).hexdigest()[:24]


def _named(specification: Specification, field: str | None) -> Any:
    return None if field is None else getattr(specification, field)
