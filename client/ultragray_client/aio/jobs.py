"""The jobs of a service."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from contextlib import aclosing
from functools import partial
from pathlib import Path
from typing import Any

from ..connection import Pages
from ..downloads import downloaded
from ..geometry import PoseLike
from ..jobs import (
    Job,
    JobEvent,
    JobKind,
    JobState,
    Watch,
    cancel_job,
    delete_job,
    get_job,
    job_log,
    list_jobs,
    retry_job,
    submit_render,
    submit_train,
)
from .connection import AsyncConnection
from .transport import run_blocking


class AsyncJobs:
    """`client.jobs`. All raise ClientError; an id that does not exist is JobNotFound.

    A submission has a `request_id`, one of its own unless one is given: the same id with the same job gives the job
    that is there, with another one RequestIdConflict. A `priority` is from -1000 to 1000, higher ones go first.
    """

    def __init__(self, connection: AsyncConnection) -> None:
        self._connection = connection

    async def train(
        self,
        dataset: str,
        scene: str,
        *,
        preset: str = "fast",
        settings: Mapping[str, Any] | None = None,
        device: str = "auto",
        request_id: str | None = None,
        priority: int = 0,
        timeout_s: float | None = None,
    ) -> Job:
        """Puts a training into the queue: the dataset becomes a scene that is served under the name `scene`.

        `preset` "fast" or "paper"; `settings` replace some of its training settings. Raises DatasetNotFound,
        SceneExists, JobQueueFull, InvalidArgument.
        """
        operation = submit_train(
            dataset,
            scene,
            preset=preset,
            settings=settings,
            device=device,
            request_id=request_id,
            priority=priority,
        )
        return await self._connection.answer(operation, timeout_s)

    async def render(
        self,
        scene: str,
        *,
        poses: Iterable[PoseLike] | None = None,
        sampler: Mapping[str, Any] | None = None,
        height: int | None = None,
        width: int | None = None,
        outputs: Sequence[str] = ("bmode",),
        format: str = "npz",
        dtype: str = "",
        min_confidence: float | None = None,
        request_id: str | None = None,
        priority: int = 0,
        timeout_s: float | None = None,
    ) -> Job:
        """Puts frames into the queue that become one archive: of `poses`, mm, or of a `sampler` such as
        `{"kind": "fan", "tilt_deg": 10, "step_deg": 2}`, around the poses or else the scene's training poses.

        A sampler's `kind` is training, around, spline, fan or covered. `format` "npz", "tar", "zarr", "hdf5", "dicom"
        or "plus"; `dtype` "uint8" or "float32", empty: the format's own. A pose whose confidence is below
        `min_confidence`, 0 to 1, is refused; a sampler keeps within it. Raises SceneNotFound, JobQueueFull,
        ExtraMissing, StorageFull, LowConfidence and other kinds of InvalidArgument.
        """
        operation = submit_render(
            scene,
            poses=poses,
            sampler=sampler,
            height=height,
            width=width,
            outputs=outputs,
            archive_format=format,
            dtype=dtype,
            min_confidence=min_confidence,
            request_id=request_id,
            priority=priority,
        )
        return await self._connection.answer(operation, timeout_s)

    async def list(
        self,
        *,
        state: JobState | str | None = None,
        kind: JobKind | str | None = None,
        limit: int | None = None,
        timeout_s: float | None = None,
    ) -> tuple[Job, ...]:
        """The newest jobs first, at most `limit`; None: all that the service keeps."""
        return await self._connection.all_pages(Pages(partial(list_jobs, state, kind), limit), timeout_s)

    async def get(self, job_id: str, *, timeout_s: float | None = None) -> Job:
        """One job."""
        return await self._connection.answer(get_job(job_id), timeout_s)

    def watch(self, job_id: str, *, timeout_s: float | None = None) -> AsyncIterator[JobEvent]:
        """The job at first and whenever it changed, and new lines of its log, until it is in its final state.

        Goes on where the service was restarted in the meantime. Without `timeout_s` it takes as long as the job.
        """
        return self._connection.converse(Watch(job_id), timeout_s)

    async def wait(self, job_id: str, *, timeout_s: float | None = None) -> Job:
        """The job in its final state, whichever that is."""
        job = None
        async for event in self.watch(job_id, timeout_s=timeout_s):
            job = event.job or job
        assert job is not None
        return job

    async def cancel(self, job_id: str, *, timeout_s: float | None = None) -> Job:
        """Stops a job within a second. Raises JobFinished for one that succeeded or failed."""
        return await self._connection.answer(cancel_job(job_id), timeout_s)

    async def retry(self, job_id: str, *, timeout_s: float | None = None) -> Job:
        """A new job in place of a failed or cancelled one; asked again, the same one. Raises JobNotFinished."""
        return await self._connection.answer(retry_job(job_id), timeout_s)

    async def delete(self, job_id: str, *, timeout_s: float | None = None) -> None:
        """Removes a finished job and its files; a scene that it trained stays. Raises JobInUse."""
        await self._connection.answer(delete_job(job_id), timeout_s)

    async def log(self, job_id: str, *, max_bytes: int = 65536, timeout_s: float | None = None) -> str:
        """The end of what the job's process said."""
        return await self._connection.answer(job_log(job_id, max_bytes), timeout_s)

    async def download(self, job_id: str, artifact: str, path: str | Path, *, timeout_s: float | None = None) -> None:
        """Writes an artifact to the file `path`, whole or not at all; goes on where the connection broke.

        Raises ArtifactNotFound, and OSError where the file cannot be written.
        """
        with downloaded(job_id, artifact, Path(path)) as download:
            chunks = self._connection.converse(download, timeout_s)
            async with aclosing(chunks):
                async for chunk in chunks:
                    await run_blocking(download.write, chunk)
