"""The gate before the queue: a worker takes a job only while it can do one.

The artifact folder must be the one that the jobs belong to, and the worker's device must be its own: a worker that
waits leaves the jobs to others.
"""

from __future__ import annotations

import logging
import os
import signal
import time
from contextlib import suppress

from ...errors import ArtifactFolderUnavailable
from ..queue import heartbeat
from ..queue.folder_identity import FolderIdentity
from .device import DeviceLock
from .processes import holder_of, is_stopped

_log = logging.getLogger("ultragray.jobs")


class Gate:
    """Opens for one job at a time."""

    def __init__(self, folder: FolderIdentity, device: DeviceLock) -> None:
        self.folder, self.device = folder, device
        self._stopped: tuple[tuple[int, str], float] | None = None  # a holder of the device, and since when
        self._is_folder_there = True
        self._closed_until_s = float("-inf")
        self.is_resting = False  # an administrator wants no jobs to be taken

    def opens(self) -> bool:
        """Whether a job may be taken now; then the device is held until `close`."""
        if self.is_resting or time.monotonic() < self._closed_until_s or not self._has_folder():
            return False
        try:
            if not self.device.take():
                self._end_stopped_holder()
                return False
        except OSError as error:
            _log.error(f"no job is taken: the lock of {self.device.device.name} cannot be used: {error.strerror}")
            return False
        return True

    def close(self, *, for_s: float = 0.0) -> None:
        """Lets others have the device; the gate stays closed for so many seconds at least."""
        self._closed_until_s = max(self._closed_until_s, time.monotonic() + for_s)
        self.device.release()

    def _has_folder(self) -> bool:
        try:
            self.folder.check()
        except ArtifactFolderUnavailable as error:
            if self._is_folder_there:
                _log.error(f"no job is taken: {error.detail}")
            self._is_folder_there = False
            return False
        if not self._is_folder_there:
            _log.warning("the artifact folder is back: jobs are taken again")
        self._is_folder_there = True
        return True

    def _end_stopped_holder(self) -> None:
        """Ends a worker of this host that was stopped for so long that it is dead to all others.

        It would keep the device for ever, and on SQLite perhaps the database, too, which therefore is not asked.
        """
        holder = holder_of(self.device.path)
        if holder is None or not is_stopped(holder[0]):
            self._stopped = None
            return
        now_s = time.monotonic()
        if self._stopped is None or self._stopped[0] != holder:
            self._stopped = (holder, now_s)
        elif now_s - self._stopped[1] > heartbeat.DEAD_AFTER_S:
            pid, worker = holder
            name = self.device.device.name
            _log.warning(f"the worker {worker} (process {pid}) was stopped, and kept {name}: it is ended")
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
