"""Jobs for both front doors: the store, without blocking the event loop, and those who watch a job."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Concatenate, ParamSpec, TypeVar

from sqlalchemy.exc import SQLAlchemyError

from ultragray.contract import described, under
from ultragray.errors import DatasetInvalid, InvalidArgument, SceneFileInvalid, UltragrayError
from ultragray.geometry.registration import Registration
from ultragray_service.access.audit import account
from ultragray_service.access.owners import may_see
from ultragray_service.access.principals import acting
from ultragray_service.core.jobs.database_threads import PATIENCE_S, DatabaseThreads
from ultragray_service.core.jobs.hub import JobHub
from ultragray_service.core.scenes import MAX_PAGE_SIZE, scene_to_blame
from ultragray_service.settings import Settings
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import (
    DatasetNotFound,
    NotReady,
    RegistrationNotFound,
    SceneExists,
    SceneNotFound,
)
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.files import JobFiles
from ultragray_workers.jobs.kinds import Specification
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.record import Job
from ultragray_workers.jobs.store import Admit, JobsOverview, JobStore
from ultragray_workers.jobs.workers import Worker
from ultragray_workers.rounds import Rounds
from ultragray_workers.scenes import SceneStore
from ultragray_workers.storage.location import open_storage

COUNT_INTERVAL_S = 10.0
_BESIDE_SPECIFICATION = ("request_id", "priority")

_log = logging.getLogger("ultragray.service")

P = ParamSpec("P")
T = TypeVar("T")


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
    ) -> None:
        """`registration`: finds that of a name, for a scene; it blocks, as `admit` does, which each new job passes."""
        self._settings = settings
        self._scenes = scenes
        self._datasets = datasets
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
        self._counting = asyncio.create_task(self._count())

    async def do(self, method: Callable[Concatenate[JobStore, P], T], *arguments: P.args, **options: P.kwargs) -> T:
        """Calls a method of the store in a thread: `do(JobStore.get, job_id)`.

        Raises what the method raises, NotReady before the start, DatabaseUnavailable where the database is silent.
        """
        return await self.threads.ask(method, self._store, *arguments, **options)

    async def submit(
        self, specification: Specification, *, field: str, request_id: str | None, priority: int, private: bool
    ) -> tuple[Job, bool]:
        """The job, and whether it is new. `field` is where the caller wrote the specification.

        Raises InvalidArgument, JobConflict, JobQueueFull, DatasetNotFound, DatasetInvalid, SceneNotFound,
        SceneFileInvalid, SceneExists, RegistrationNotFound, LimitReached.
        """
        with _specification_to_blame(field):
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
        """One page of jobs; empty filters pass all.

        Raises InvalidArgument for a page_size outside 1 to 1000 and for a token that no page gave.
        """
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
        rounds = Rounds("the count of the jobs", _log)
        while True:
            with rounds.round():
                try:
                    self.overview = await self.do(JobStore.overview)
                except (UltragrayError, SQLAlchemyError):
                    self.overview = JobsOverview()
            await asyncio.sleep(COUNT_INTERVAL_S)


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
