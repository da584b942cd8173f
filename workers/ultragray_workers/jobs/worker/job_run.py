"""The run of a job in its process: its folder, its request, its progress, and whether it is to stop."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

from ..folder import JobFolder, Progress, Request
from ..shards.channel import Channel

_PROGRESS_INTERVAL_S = 0.5


class Stopped(Exception):
    """Raised where the worker stops; the job goes on later."""


class JobRun:
    """One job in its process."""

    def __init__(
        self, folder: JobFolder, request: Request, should_stop: Callable[[], bool], channel: Channel | None = None
    ) -> None:
        """`channel`: to the worker, of a job in shards."""
        self.folder, self.request, self.should_stop, self.channel = folder, request, should_stop, channel
        self.progress = folder.progress()
        self._reported_at = float("-inf")

    def report(self, progress: Progress) -> None:
        """Writes how far the job is, at most twice a second."""
        self.progress = progress
        if time.monotonic() - self._reported_at >= _PROGRESS_INTERVAL_S:
            with suppress(OSError):  # where there is no room, the work itself will say so
                self.folder.write_progress(progress)
            self._reported_at = time.monotonic()
