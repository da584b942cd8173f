"""What the work of a job has of its process: its folder, its request, a way to tell progress and to be stopped."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

from .folder import JobFolder, Progress, Request

_PROGRESS_INTERVAL_S = 0.5


class Stopped(Exception):
    """The worker stops; the job goes on later."""


class Work:
    """One job at work."""

    def __init__(self, folder: JobFolder, request: Request, should_stop: Callable[[], bool]) -> None:
        self.folder, self.request, self.should_stop = folder, request, should_stop
        self.progress = folder.progress()
        self._told_at = float("-inf")

    def report(self, progress: Progress) -> None:
        """Tells how far the job is, at most twice a second."""
        self.progress = progress
        if time.monotonic() - self._told_at >= _PROGRESS_INTERVAL_S:
            with suppress(OSError):  # where there is no room, the work itself will say so
                self.folder.write_progress(progress)
            self._told_at = time.monotonic()
