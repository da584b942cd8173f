"""The gate before the queue: a worker takes a job only while it can do one, and only one that it can do.

The artifact folder must be the one that the jobs belong to, and a device that fits a waiting job must be the worker's
own: a worker that waits leaves the jobs to others.
"""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress

from ultragray_workers.errors import ArtifactFolderUnavailable, DatabaseUnavailable
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.demand import Demand, Offer, demand_of_key
from ultragray_workers.jobs.identity import StoreIdentity
from ultragray_workers.jobs.worker.device import DeviceLock
from ultragray_workers.jobs.worker.process import holder_of, is_stopped

_CHECKED_FOR_S = 2.0  # how long an artifact folder counts as the right one

_log = logging.getLogger("ultragray.jobs")


class Gate:
    """Opens for one job at a time."""

    def __init__(
        self,
        identity: StoreIdentity,
        devices: Sequence[DeviceLock],
        labels: tuple[tuple[str, str], ...],
        waiting: Callable[[], Iterable[str]],
    ) -> None:
        """`devices`: those that the worker offers, the preferred one first. `waiting`: the demands of waiting jobs."""
        self.identity = identity
        self.offer = Offer(tuple(lock.device for lock in devices), labels)
        self._locks = {lock.device.name: lock for lock in devices}
        self._waiting = waiting
        self._stopped: dict[str, tuple[tuple[int, str], float]] = {}  # the holder of a device, and since when
        self._is_folder_there = True
        self._closed_until_s = float("-inf")
        self.is_resting = False  # an administrator wants no jobs to be taken

    def opens(self) -> list[str]:
        """The keys of the demands of which a job may be taken now; none: no job may be.

        Devices that fit them are held until `hold` or `close`.
        """
        if self.is_resting or time.monotonic() < self._closed_until_s or not self._has_folder():
            return []
        # The database is asked only with a device in hand: whoever holds all and was stopped may hold it, too.
        if not any(self._takes(lock) for lock in self._locks.values()):
            return []
        fitting: dict[str, set[str]] = {}
        with suppress(DatabaseUnavailable):
            fitting = {key: self._fitting(demand_of_key(key)) for key in self._waiting()}
        wanted = set().union(*fitting.values())  # which one it will be is known when the job is
        held = {name for name, lock in self._locks.items() if name in wanted and self._takes(lock)}
        if not held:
            self.close()
        return [key for key, names in fitting.items() if names & held]

    def hold(self, demand: Demand) -> DeviceLock | None:
        """The lock of a device that fits a job, held; the others are let go. None: all of them are in use.

        Raises OSError.
        """
        fitting = [self._locks[device.name] for device in self.offer.fitting(demand)]
        chosen = next((lock for lock in fitting if lock.take()), None)
        for lock in self._locks.values():
            if lock is not chosen:
                lock.release()
        return chosen

    def close(self, *, for_s: float = 0.0) -> None:
        """Lets others have the devices; the gate stays closed for so many seconds at least."""
        self._closed_until_s = max(self._closed_until_s, time.monotonic() + for_s)
        for lock in self._locks.values():
            lock.release()

    def _fitting(self, demand: Demand) -> set[str]:
        return {device.name for device in self.offer.fitting(demand)}

    def _takes(self, lock: DeviceLock) -> bool:
        """Whether the device of a lock is held now."""
        try:
            if lock.take():
                self._stopped.pop(lock.device.name, None)
                return True
            self._end_stopped_holder(lock)
        except OSError as error:
            _log.error(f"no job is taken: the lock of {lock.device.name} cannot be used: {error.strerror}")
        return False

    def _has_folder(self) -> bool:
        try:
            self.identity.check(_CHECKED_FOR_S)
        except ArtifactFolderUnavailable as error:
            if self._is_folder_there:
                _log.error(f"no job is taken: {error.detail}")
            self._is_folder_there = False
            return False
        if not self._is_folder_there:
            _log.warning("the artifact folder is back: jobs are taken again")
        self._is_folder_there = True
        return True

    def _end_stopped_holder(self, lock: DeviceLock) -> None:
        """Ends a worker of this host that was stopped for so long that it is dead to all others.

        It would keep the device for ever, and on SQLite perhaps the database, too, which therefore is not asked.
        """
        holder, name = holder_of(lock.path), lock.device.name
        if holder is None or not is_stopped(holder[0]):
            self._stopped.pop(name, None)
            return
        now_s = time.monotonic()
        known, since_s = self._stopped.get(name, (None, now_s))
        if known != holder:
            self._stopped[name] = (holder, now_s)
        elif now_s - since_s > queue.DEAD_AFTER_S:
            pid, worker = holder
            _log.warning(f"the worker {worker} (process {pid}) was stopped, and kept {name}: it is ended")
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
