"""Jobs for all front doors: the store in threads of its own, those who watch a job and its log, and estimates."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import copy_context
from dataclasses import dataclass
from functools import partial
from typing import Concatenate, ParamSpec, TypeAlias, TypeVar

from sqlalchemy.exc import SQLAlchemyError

from ultragray.contract import described, to_dict, under
from ultragray.errors import DatasetInvalid, InvalidArgument, SceneFileInvalid, UltragrayError
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.registration import Registration
from ultragray.rendering.settings import Encoding
from ultragray_service.access.audit import account
from ultragray_service.access.limits import Slots
from ultragray_service.access.owners import may_see
from ultragray_service.access.principals import acting
from ultragray_service.core.rendering import Plan, Rendering
from ultragray_service.core.scenes import MAX_PAGE_SIZE, scene_to_blame
from ultragray_service.core.threads import HelperProcesses
from ultragray_service.settings import Settings
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import (
    DatabaseUnavailable,
    DatasetNotFound,
    DeadlineExceeded,
    NotReady,
    QueueFull,
    RegistrationNotFound,
    SceneExists,
    SceneNotFound,
    StorageUnavailable,
)
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.files import JobFiles, Log
from ultragray_workers.jobs.kinds import RenderJob, Specification
from ultragray_workers.jobs.kinds.base import check_carried
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.record import Job
from ultragray_workers.jobs.store import Admit, JobsOverview, JobStore
from ultragray_workers.jobs.workers import Worker
from ultragray_workers.pool.messages import Priority
from ultragray_workers.rounds import repeat
from ultragray_workers.scenes import SceneStore
from ultragray_workers.storage.location import open_storage

PATIENCE_S = 10.0  # with a database that is there and says nothing
_THREADS = 4

D = TypeVar("D")  # a store or an engine
P = ParamSpec("P")
T = TypeVar("T")


class DatabaseThreads:
    def __init__(self) -> None:
        self.executor = ThreadPoolExecutor(_THREADS, "database")

    async def ask(
        self, question: Callable[Concatenate[D, P], T], target: D, *details: P.args, **options: P.kwargs
    ) -> T:
        """Calls `question(target, *details, **options)` in a thread, in the caller's context.

        What is hidden from the caller is not found.

        Raises what it raises, and DatabaseUnavailable where there is no answer within PATIENCE_S.
        """
        call = partial(copy_context().run, question, target, *details, **options)
        answer = asyncio.get_running_loop().run_in_executor(self.executor, call)
        try:
            return await asyncio.wait_for(answer, PATIENCE_S)
        except asyncio.TimeoutError:
            raise DatabaseUnavailable(
                f"the database of the jobs has not answered for {PATIENCE_S:g} s: try again later"
            ) from None


DEFAULT_LOG_BYTES, MAX_LOG_BYTES = 65536, 2**20  # of the log's end, given at once
TAIL_BYTES = 8192  # of the log, for a watcher who names no place
_STEP_BYTES = 65536  # at most, of one read


class GrowingLog:
    """Reads a log step by step; one that does not exist yet is empty."""

    def __init__(self, log: Log, offset: int | None = None) -> None:
        """`offset`: the byte of the log to go on from; None: the last lines that are there at the first read."""
        self._log, self._offset = log, offset
        self.has_more = False  # whether there may be more to read at once

    @property
    def offset(self) -> int:
        return self._offset or 0

    def read(self) -> str:
        """The next whole lines; a line longer than a step comes in pieces. A log that became shorter is read anew."""
        self._offset = self._begin()
        added = self._log.read(self._offset, _STEP_BYTES)
        self.has_more = len(added) == _STEP_BYTES
        end = added.rfind(b"\n") + 1
        if not end and self.has_more:
            end = len(added)
        self._offset += end
        return added[:end].decode("utf-8", "replace")

    def _begin(self) -> int:
        size = self._log.size()
        if self._offset is not None:
            return self._offset if self._offset <= size else 0
        begin = max(0, size - TAIL_BYTES)
        return begin and begin + self._log.read(begin, TAIL_BYTES).find(b"\n") + 1


READ_INTERVAL_S = 0.5


@dataclass(frozen=True)
class JobChange:
    """News of a job: its state and progress where they changed, and new lines of its log."""

    job: Job | None
    log: str
    log_offset: int  # the byte of the log after these lines


Looked: TypeAlias = tuple[Job, int]  # a job, and the bytes of its log


class JobWatch:
    """One watcher's part. A watcher that reads slowly gets the newest state and every line of the log."""

    def __init__(self, look: Callable[[], Awaitable[Looked]], log: GrowingLog, hub: JobHub) -> None:
        self._look, self._log, self._hub = look, log, hub
        self._last_state: Looked | None = None
        self._last_job: Job | None = None
        self.finished = False  # whether the client has the final state

    async def next(self, timeout_s: float) -> JobChange | None:
        """The changes since the last call, after at most `timeout_s` seconds (none: an empty change).

        The final state comes with the last lines or after them; then None, as when the service stops. Raises what
        reading the job raises.
        """
        end = time.monotonic() + timeout_s
        while not self.finished and not self._hub.closing.is_set():
            try:
                state = await self._look()
            except (DatabaseUnavailable, StorageUnavailable):
                if self._last_state is None:
                    raise
                state = self._last_state  # it comes back, and the watchers have nothing else to do
            if self._log.has_more or state != self._last_state:
                self._last_state = state
                change = await self._change(state[0])
                if change.job is not None or change.log:
                    return change
            if (left_s := end - time.monotonic()) <= 0:
                return JobChange(None, "", self._log.offset)
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._hub.closing.wait(), min(READ_INTERVAL_S, left_s))
        return None

    async def _change(self, job: Job) -> JobChange:
        # After the state was read, so that the log of a finished job is whole.
        lines = await self._hub.in_thread(self._log.read)
        if job == self._last_job or (job.state.is_final and self._log.has_more):
            return JobChange(None, lines, self._log.offset)
        self._last_job, self.finished = job, job.state.is_final
        return JobChange(job, lines, self._log.offset)


class JobHub:
    """The watchers of all jobs, for each of which a job is read once in READ_INTERVAL_S. Belongs to one event loop."""

    def __init__(self, get: Callable[[str], Job], log: Callable[[str], Log], threads: Executor | None = None) -> None:
        self._get, self._log, self._threads = get, log, threads
        self._reads: dict[str, tuple[float, asyncio.Future[Looked]]] = {}  # when each began
        self.closing = asyncio.Event()

    async def watch(self, job_id: str, log_offset: int | None = None) -> JobWatch:
        """A watcher of a job and its log from `log_offset` on (None: its end). Raises JobNotFound."""
        look = partial(self._look, job_id, self._log(job_id))
        await look()
        return JobWatch(look, GrowingLog(self._log(job_id), log_offset), self)

    async def _look(self, job_id: str, log: Log) -> Looked:
        def look() -> Looked:
            job = self._get(job_id)  # first, so that the log of a finished job is whole
            return job, log.size()

        now = time.monotonic()
        self._reads = {name: read for name, read in self._reads.items() if now - read[0] < READ_INTERVAL_S}
        if job_id not in self._reads:
            self._reads[job_id] = now, asyncio.ensure_future(self.in_thread(look))
        return await asyncio.shield(self._reads[job_id][1])

    def in_thread(self, call: Callable[[], T]) -> Awaitable[T]:
        return asyncio.get_running_loop().run_in_executor(self._threads, call)


MAX_POSES = 256  # that an estimate tells
_TIMED_FRAMES = 2  # one after the other: the first may load the scene


@dataclass(frozen=True)
class JobEstimate:
    """What a render job would make; nothing is submitted."""

    frames: int = described("Frames; a sampler that keeps to a least confidence may leave some out.")
    files: int = described("Files that they become.")
    height: int = described("Of a frame, pixels.")
    width: int = described("Of a frame, pixels.")
    bytes: int = described("Of the files, at most: as they are before they are compressed.")
    seconds: float | None = described(
        "Rendering on the processes of this service, one frame after the other; null where they are too busy to tell. "
        "Workers with a GPU, or several of them, are faster."
    )
    poses: list[list[float]] = described(
        f"At most {MAX_POSES} of the poses, evenly spread: 16 numbers each, row by row, mm."
    )


async def estimate(rendering: Rendering, specification: Specification, *, field: str) -> JobEstimate:
    """Raises InvalidArgument for another kind, and what the submission would; `field`: where the caller wrote it."""
    if not isinstance(specification, RenderJob):
        raise InvalidArgument(
            f"only render jobs can be estimated, this is of the kind {specification.kind}", field="kind"
        )
    with under(field):
        plan = await rendering.planner.plan(
            specification.scene, specification, Encoding.UINT8, registration=specification.registration
        )
        if plan.registration is not None:
            specification = specification.registered(plan.registration)
        settings = plan.settings
        frames, poses = await asyncio.to_thread(specification.outlook, plan.header, settings, MAX_POSES)
        picture = specification.file_format.shown(settings).picture
    frame_s = await _frame_s(rendering, plan, poses[:1])
    return JobEstimate(
        frames=frames,
        files=specification.file_count(frames),
        height=picture.height,
        width=picture.width,
        bytes=specification.file_bytes(frames, picture),
        seconds=None if frame_s is None else frames * frame_s,
        poses=poses.reshape(-1, 16).tolist(),
    )


async def _frame_s(rendering: Rendering, plan: Plan, poses: FloatArray) -> float | None:
    """The seconds that one frame takes; None where there is no room for it now."""
    deadline, took_ms = rendering.planner.deadline(None), 0.0
    try:
        for _ in range(_TIMED_FRAMES):
            await rendering.limits.take_frames(len(poses), deadline)
            took_ms = (await rendering.render(plan, poses, priority=Priority.BATCH, deadline=deadline)).render_ms
    except (DeadlineExceeded, QueueFull):
        return None
    return took_ms / 1000.0


COUNT_INTERVAL_S = 10.0
FILE_CHECK_TIMEOUT_S = 600.0
MAX_FILES_CHECKED = 8  # they wait for their turn in the helper process
_BESIDE_SPECIFICATION = ("request_id", "priority")

_log = logging.getLogger("ultragray.service")


@dataclass(frozen=True)
class JobPage:
    """One page of jobs, newest first."""

    jobs: list[Job]
    next_page_token: str = described("Empty on the last page.")


@dataclass(frozen=True)
class WorkerList:
    """The workers of the queue."""

    workers: tuple[Worker, ...] = described("By name; also those that were lost within a day.")


class Jobs:
    def __init__(
        self,
        settings: Settings,
        scenes: SceneStore,
        datasets: DatasetStore,
        registration: Callable[[str, str], Registration],
        admit: Admit,
        checks: HelperProcesses,
    ) -> None:
        """`registration`: finds that of a name, for a scene; it blocks, as `admit` does, which each new job passes.

        `checks`: of files that come with jobs.
        """
        self._checks, self._checked = checks, Slots(MAX_FILES_CHECKED, "files of jobs")
        self._settings, self._scenes, self._datasets = settings, scenes, datasets
        self._registration = registration
        self._opened: JobStore | None = None
        self.threads = DatabaseThreads()
        self.hub = JobHub(
            lambda job_id: self._store.get(job_id), lambda job_id: self.files.log(job_id), self.threads.executor
        )
        self._admit = admit
        self.overview = JobsOverview()  # as it was up to COUNT_INTERVAL_S ago
        self._counting: asyncio.Task[None] | None = None

    @property
    def _store(self) -> JobStore:
        if self._opened is None:
            raise NotReady("the service is starting")
        return self._opened

    async def open(self) -> None:
        settings = self._settings
        self._opened = await asyncio.to_thread(
            JobStore,
            settings.working_folder,
            settings.database_url,
            settings.job_queue_limit,
            scenes=self._scenes,
            datasets=self._datasets,
            registration=self._registration,
            storage=open_storage(settings.artifacts, patience_s=PATIENCE_S / 2),
            max_image_side=settings.max_image_side,
        )

    @property
    def database(self) -> JobDatabase:
        return self._store.database

    @property
    def files(self) -> JobFiles:
        return self._store.files

    def start(self) -> None:
        self._counting = asyncio.create_task(repeat("the count of the jobs", _log, COUNT_INTERVAL_S, self._count))

    async def do(self, method: Callable[Concatenate[JobStore, P], T], *arguments: P.args, **options: P.kwargs) -> T:
        """Calls a method of the store in a thread: `do(JobStore.get, job_id)`. Raises NotReady, DatabaseUnavailable."""
        return await self.threads.ask(method, self._store, *arguments, **options)

    async def submit(
        self, specification: Specification, *, field: str, request_id: str | None, priority: int, private: bool
    ) -> tuple[Job, bool]:
        """The job, and whether it is new. `field` is where the caller wrote the specification.

        Raises InvalidArgument, JobConflict, JobQueueFull, DatasetNotFound, DatasetInvalid, SceneNotFound,
        SceneFileInvalid, SceneExists, RegistrationNotFound, LimitReached, and QueueFull for a file that comes with it.
        """
        with _specification_to_blame(field):
            if specification.carried is not None:
                with self._checked.one():
                    await self._checks.run(
                        check_carried,
                        {"document": to_dict(specification)},
                        what="checking the file of the job",
                        timeout_s=FILE_CHECK_TIMEOUT_S,
                        killed=InvalidArgument,
                    )
            job, is_new = await self.do(
                JobStore.submit,
                specification,
                request_id=request_id,
                priority=priority,
                owner=acting().name,
                private=private,
                admit=self._admit,
            )
        account().target = job.id
        return job, is_new

    async def retry(self, job_id: str) -> tuple[Job, bool]:
        return await self.do(JobStore.retry, job_id, by=acting().name, admit=self._admit)

    async def page(self, *, state: str, kind: str, page_size: int, page_token: str) -> JobPage:
        """One page of jobs; empty filters pass all. Raises InvalidArgument."""
        if not 1 <= page_size <= MAX_PAGE_SIZE:
            raise InvalidArgument(
                f"page_size must be an integer from 1 to {MAX_PAGE_SIZE}, got {page_size}", field="page_size"
            )
        jobs, token = await self.do(
            JobStore.list,
            state=JobState(state) if state else None,
            kind=kind or None,
            shown=partial(may_see, acting()),
            page_size=page_size,
            page_token=page_token or None,
        )
        return JobPage(jobs, token or "")

    async def workers(self) -> WorkerList:
        return WorkerList(await self.do(JobStore.workers, partial(may_see, acting())))

    def uses_dataset(self, name: str) -> str | None:
        return self._store.uses_dataset(name, partial(may_see, acting()))

    async def makes_scene(self, name: str) -> str | None:
        return await self.do(JobStore.makes_scene, name, partial(may_see, acting()))

    async def close(self) -> None:
        if self._counting is not None:
            self._counting.cancel()
        if self._opened is not None:
            await asyncio.to_thread(self._opened.close)

    async def _count(self) -> None:
        try:
            self.overview = await self.do(JobStore.overview)
        except (UltragrayError, SQLAlchemyError):
            self.overview = JobsOverview()


@contextmanager
def _specification_to_blame(field: str) -> Iterator[None]:
    try:
        with scene_to_blame():
            yield
    except InvalidArgument as error:
        if error.field in _BESIDE_SPECIFICATION:
            raise
        with under(field):
            raise
    except (DatasetInvalid, DatasetNotFound, RegistrationNotFound, SceneExists, SceneFileInvalid, SceneNotFound):
        with under(field):
            raise
