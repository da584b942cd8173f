"""Watching jobs: one reader for each job that is watched, however many watch it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

from ultragray_service.core.jobs.log import GrowingLog
from ultragray_workers.errors import DatabaseUnavailable, StorageUnavailable
from ultragray_workers.jobs.files import Log
from ultragray_workers.jobs.record import Job

READ_INTERVAL_S = 0.5


@dataclass(frozen=True)
class JobChange:
    """News of a job: its state and progress where they changed, and new lines of its log."""

    job: Job | None
    log: str
    log_offset: int  # the byte of the log after these lines


class JobWatch:
    """One watcher's part. A watcher that reads slowly gets the newest state and every line of the log."""

    def __init__(self, log: GrowingLog, threads: Executor | None, leave: Callable[[JobWatch], None]) -> None:
        self._log, self._threads, self._leave = log, threads, leave
        self._job: Job | None = None
        self.finished = False  # whether the final state was told
        self._ended = False
        self._error: Exception | None = None
        self._news = asyncio.Event()

    async def next(self, timeout_s: float) -> JobChange | None:
        """The changes since the last call, after at most `timeout_s` seconds (none: an empty change).

        The final state comes with the last lines or after them; then None, as when the service stops. Raises what
        reading the job raises.
        """
        loop = asyncio.get_running_loop()
        end = loop.time() + timeout_s
        while True:
            if self._news.is_set():
                change = await self._take()
                if change.job is not None or change.log:
                    return change
            elif self._ended:
                if self._error is not None:
                    raise self._error
                return None
            else:
                try:
                    await asyncio.wait_for(self._news.wait(), max(0.0, end - loop.time()))
                except asyncio.TimeoutError:
                    return JobChange(None, "", self._log.offset)

    async def _take(self) -> JobChange:
        self._news.clear()
        job, self._job = self._job, None
        # After the state was read, so that the log of a finished job is whole.
        lines = await asyncio.get_running_loop().run_in_executor(self._threads, self._log.read)
        if self._log.has_more:
            self._news.set()
            if job is not None and job.state.is_final:
                job, self._job = None, job
        return JobChange(job, lines, self._log.offset)

    def tell(self, job: Job | None) -> None:
        """The job's newest state where it changed, or else that its log grew."""
        if job is not None:
            self._job = job
            self.finished = job.state.is_final
        self._news.set()

    def end(self, error: Exception | None = None) -> None:
        self._ended = True
        self._error = error
        self._news.set()

    def close(self) -> None:
        self._leave(self)


class _Reader:
    """Reads one job for all of its watchers, until its final state or until nobody watches."""

    def __init__(self, read: Callable[[], Job], log: Log, threads: Executor | None) -> None:
        self._read = read
        self._threads = threads
        self._log = log
        self._log_bytes = 0
        self._job: Job | None = None
        self.watches: set[JobWatch] = set()
        self.task = asyncio.ensure_future(self._run())

    def add(self, watch: JobWatch) -> None:
        self.watches.add(watch)
        if self._job is not None:
            watch.tell(self._job)

    async def _run(self) -> None:
        error: Exception | None = None
        try:
            while self._job is None or not self._job.state.is_final:
                if self._job is not None:
                    await asyncio.sleep(READ_INTERVAL_S)
                try:
                    job, log_bytes = await asyncio.get_running_loop().run_in_executor(self._threads, self._look)
                except (DatabaseUnavailable, StorageUnavailable):
                    if self._job is None:
                        raise
                    continue  # it comes back, and the watchers have nothing else to do
                changed = job if job != self._job else None
                has_grown = log_bytes != self._log_bytes
                self._job, self._log_bytes = job, log_bytes
                if changed is not None or has_grown:
                    for watch in self.watches:
                        watch.tell(changed)
        except Exception as raised:
            error = raised
        finally:
            for watch in self.watches:
                watch.end(error)

    def _look(self) -> tuple[Job, int]:
        job = self._read()  # first, so that the log of a finished job is whole
        return job, self._log.size()


class JobHub:
    """The watchers of all jobs. Belongs to one event loop."""

    def __init__(self, get: Callable[[str], Job], log: Callable[[str], Log], threads: Executor | None = None) -> None:
        self._get = get
        self._threads = threads
        self._log = log
        self._readers: dict[str, _Reader] = {}
        self._closed = False

    @property
    def readers(self) -> int:
        return len(self._readers)

    async def watch(self, job_id: str, log_offset: int | None = None) -> JobWatch:
        """A watcher of a job, whose first change tells the job, and of its log what follows `log_offset`.

        None: the last lines. It must be closed. Raises JobNotFound.
        """
        reader = self._readers.get(job_id)
        if reader is None or reader.task.done():
            await asyncio.get_running_loop().run_in_executor(self._threads, self._get, job_id)
            reader = self._readers.get(job_id)  # another watcher may have come in the meantime
        log = GrowingLog(self._log(job_id), log_offset)
        if self._closed:
            over = JobWatch(log, self._threads, lambda leaving: None)
            over.end()
            return over
        if reader is None or reader.task.done():
            reader = _Reader(partial(self._get, job_id), self._log(job_id), self._threads)
            self._readers[job_id] = reader
        watch = JobWatch(log, self._threads, partial(self._remove, job_id, reader))
        reader.add(watch)
        return watch

    def _remove(self, job_id: str, reader: _Reader, watch: JobWatch) -> None:
        reader.watches.discard(watch)
        if not reader.watches:
            reader.task.cancel()
            if self._readers.get(job_id) is reader:
                del self._readers[job_id]

    def close(self) -> None:
        self._closed = True
        for reader in self._readers.values():
            reader.task.cancel()
            for watch in reader.watches:
                watch.end()
