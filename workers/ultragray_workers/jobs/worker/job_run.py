"""The run of a job in its process: its folder, its request, its progress, and whether it is to stop."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, TypeVar

from ultragray_workers.datasets.store import open_datasets
from ultragray_workers.errors import StorageUnavailable
from ultragray_workers.jobs.folder import JobFolder, Request
from ultragray_workers.jobs.progress import Progress

if TYPE_CHECKING:
    from ultragray.datasets import Dataset

_PROGRESS_INTERVAL_S = 0.5
_RETRY_S = 1.0  # while a storage or the database is away
_T = TypeVar("_T")


class Stopped(Exception):
    """Raised where the worker stops; the job goes on later."""


class JobRun:
    def __init__(self, folder: JobFolder, request: Request, should_stop: Callable[[], bool]) -> None:
        self.folder, self.request, self.should_stop = folder, request, should_stop
        self.progress = folder.progress()
        self._reported_at = float("-inf")

    def load_dataset(self, name: str) -> Dataset:
        """A dataset of the service, its warnings in the log; waits for a storage that is away.

        Raises Stopped, DatasetNotFound, DatasetInvalid.
        """
        request = self.request
        datasets = open_datasets(self.folder.artifact_folder, request.storage, request.max_copies_bytes)
        dataset = self.patiently(lambda: datasets.load(name), StorageUnavailable)
        for text in self.patiently(lambda: datasets.get(name), StorageUnavailable).warnings:
            sys.stderr.write(f"warning: {text}\n")
        return dataset

    def patiently(self, work: Callable[[], _T], *away: type[Exception]) -> _T:
        """What the work gives, done again for as long as it raises one of `away`. Raises Stopped."""
        is_told = False
        while True:
            try:
                return work()
            except away as error:
                if not is_told:
                    sys.stderr.write(f"waiting: {str(error).splitlines()[0]}\n")
                is_told = True
            with suppress(OSError):
                self.folder.write_progress(self.progress)  # a sign of life to the worker
            if self.should_stop():
                raise Stopped
            time.sleep(_RETRY_S)

    def counter(self, frames: int) -> Callable[[int], None]:
        """A function that reports how many of the frames are done, since now. It raises Stopped."""
        began_s = time.monotonic()

        def count(done: int) -> None:
            if self.should_stop():
                raise Stopped
            rate = done / (time.monotonic() - began_s)
            left_s = (frames - done) / rate if done else None
            self.report(Progress(frames_done=done, frames=frames, rate_per_s=rate or None, seconds_left=left_s))

        return count

    def report(self, progress: Progress) -> None:
        """Writes how far the job is, at most twice a second, but the begin of each phase at once."""
        begins, self.progress = progress.phase != self.progress.phase, progress
        if begins or time.monotonic() - self._reported_at >= _PROGRESS_INTERVAL_S:
            with suppress(OSError):  # where there is no room, the work itself will say so
                self.folder.write_progress(progress)
            self._reported_at = time.monotonic()
