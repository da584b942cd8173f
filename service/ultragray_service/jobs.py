"""Jobs for both front doors: the store, without blocking the event loop, and who watches."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from ultragray.errors import (
    DatasetInvalid,
    DatasetNotFound,
    InvalidArgument,
    NotReady,
    SceneExists,
    SceneFileInvalid,
    SceneNotFound,
)
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.specification import Specification
from ultragray_workers.jobs.store import Job, JobState, JobStore
from ultragray_workers.scenes import SceneStore

from .catalog import MAX_PAGE_SIZE, scene_to_blame
from .job_hub import JobHub, JobWatch
from .requests import field_under
from .settings import Settings

T = TypeVar("T")


class Jobs:
    """The jobs of one service. Everything but `watch` goes to the store in a thread."""

    def __init__(self, settings: Settings, scenes: SceneStore) -> None:
        self._settings = settings
        self._scenes = scenes
        self._opened: JobStore | None = None
        self.hub = JobHub(lambda job_id: self._store.get(job_id), self._log_path)

    @property
    def _store(self) -> JobStore:
        if self._opened is None:
            raise NotReady("the service is starting")
        return self._opened

    async def start(self) -> None:
        """Opens the store. Raises StartupFailed where its database cannot be reached."""
        settings = self._settings
        self._opened = await asyncio.to_thread(
            JobStore, settings.artifacts, settings.database_url, settings.job_queue_limit, scenes=self._scenes
        )

    async def submit(
        self, specification: Specification, *, field: str, request_id: str | None, priority: int
    ) -> tuple[Job, bool]:
        """The job, and whether it is new. `field` is where the caller wrote the specification.

        Raises InvalidArgument, JobConflict, JobQueueFull, DatasetNotFound, DatasetInvalid, SceneNotFound,
        SceneFileInvalid, SceneExists.
        """
        with _specification_to_blame(field):
            return await self._do(lambda store: store.submit(specification, request_id=request_id, priority=priority))

    async def get(self, job_id: str) -> Job:
        """Raises JobNotFound."""
        return await self._do(lambda store: store.get(job_id))

    async def page(self, *, state: str, kind: str, page_size: int, page_token: str) -> tuple[list[Job], str]:
        """One page of jobs, newest first, and the token of the next (empty on the last); empty filters pass all.

        Raises InvalidArgument for a page_size outside 1 to 1000 and for a token that no page gave.
        """
        if not 1 <= page_size <= MAX_PAGE_SIZE:
            raise InvalidArgument(
                f"page_size must be an integer from 1 to {MAX_PAGE_SIZE}, got {page_size}", field="page_size"
            )
        jobs, token = await self._do(
            lambda store: store.list(
                state=JobState(state) if state else None,
                kind=kind or None,
                page_size=page_size,
                page_token=page_token or None,
            )
        )
        return jobs, token or ""

    async def cancel(self, job_id: str) -> Job:
        """Raises JobNotFound, and JobFinished for one that succeeded or failed."""
        return await self._do(lambda store: store.cancel(job_id))

    async def retry(self, job_id: str) -> Job:
        """A new job that goes on where a failed or cancelled one stopped. Raises JobNotFound, JobNotFinished."""
        return await self._do(lambda store: store.retry(job_id))

    async def log_tail(self, job_id: str, max_bytes: int) -> str:
        """The end of a job's log. Raises JobNotFound."""
        return await self._do(lambda store: store.log_tail(job_id, max_bytes))

    async def artifact(self, job_id: str, name: str) -> Path:
        """The file of an artifact. Raises JobNotFound, ArtifactNotFound."""
        return await self._do(lambda store: store.artifact(job_id, name))

    async def watch(self, job_id: str) -> JobWatch:
        """A watcher of a job, to be closed. Raises JobNotFound."""
        return await self.hub.watch(job_id)

    def uses_dataset(self, name: str) -> str | None:
        """The waiting or running job that needs a dataset; blocks. Raises NotReady before the start."""
        return self._store.uses_dataset(name)

    def end_watches(self) -> None:
        """Ends all watchers, now and from now on: the service stops."""
        self.hub.close()

    async def close(self) -> None:
        """Closes the store."""
        if self._opened is not None:
            await asyncio.to_thread(self._opened.close)

    async def _do(self, work: Callable[[JobStore], T]) -> T:
        store = self._store
        return await asyncio.to_thread(work, store)

    def _log_path(self, job_id: str) -> Path:
        return JobFolder(self._settings.artifacts, job_id).log


@contextmanager
def _specification_to_blame(field: str) -> Iterator[None]:
    """Errors about what a specification names have their field below `field`."""
    try:
        with scene_to_blame():
            yield
    except (DatasetInvalid, DatasetNotFound, SceneExists, SceneFileInvalid, SceneNotFound):
        with field_under(field):
            raise
