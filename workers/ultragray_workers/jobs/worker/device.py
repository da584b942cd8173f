"""The devices of a host: which ones a worker uses, and one job at a time on each, whichever workers share the folder.

A worker holds a device before it takes a job: those that wait for a device leave the jobs to other hosts. Free of
torch, which a process of its own asks about GPUs.
"""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from ultragray.errors import InvalidArgument
from ultragray.installation import memory_bytes, processor_name
from ultragray_workers.claims import try_lock
from ultragray_workers.errors import ArtifactFolderUnavailable, DatabaseUnavailable, StartupFailed
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.database import StoreIdentity
from ultragray_workers.jobs.demand import AUTO, CPU, CUDA, Demand, Offer, WorkerDevice, check_device, demand_of_key
from ultragray_workers.jobs.worker.process import holder_of, is_stopped

LOCK_FOLDER = "workers"  # of the artifact folder, which several hosts may share
_DRIVERS = (Path("/dev/nvidiactl"), Path("/dev/dxg"))
_ANSWER_TIMEOUT_S = 120.0
_ASK_TORCH = """
import json, torch
count = torch.cuda.device_count() if torch.cuda.is_available() else 0
found = [torch.cuda.get_device_properties(index) for index in range(count)]
print(json.dumps([[one.name, one.total_memory, str(one.uuid)] for one in found]))
"""


@dataclass(frozen=True)
class HostDevice:
    """A device as a worker offers it, and the name of its lock: the same by whatever number the host knows it."""

    offered: WorkerDevice
    lock_name: str


def devices_of(device: str) -> tuple[HostDevice, ...]:
    """The devices of this host that auto, cpu, cuda or cuda:N means, the preferred one first.

    auto: every GPU, then the processor; cuda: every GPU. Raises StartupFailed for a GPU that is not there, and for what
    is no device.
    """
    try:
        check_device(device)
    except InvalidArgument as error:
        raise StartupFailed(error.detail, field="device") from None
    if device == CPU or (device == AUTO and not any(driver.exists() for driver in _DRIVERS)):
        return (_processor(),)
    gpus = _gpus()
    if device == AUTO:
        return (*gpus, _processor())
    chosen = tuple(gpu for gpu in gpus if device in (CUDA, gpu.offered.name))
    if not chosen:
        there = ", ".join(gpu.offered.name for gpu in gpus) or "no GPU that torch can use"
        raise StartupFailed(f"device must be one of this host, got {device!r}; it has {there}", field="device")
    return chosen


def _processor() -> HostDevice:
    cores = len(os.sched_getaffinity(0))
    return HostDevice(
        WorkerDevice(name=CPU, model=processor_name(), memory_bytes=memory_bytes(), cores=cores), lock_name=CPU
    )


def _gpus() -> tuple[HostDevice, ...]:
    answer = subprocess.run(
        [sys.executable, "-c", _ASK_TORCH],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        stdout=subprocess.PIPE,
        timeout=_ANSWER_TIMEOUT_S,
        check=True,
    ).stdout
    return tuple(
        HostDevice(WorkerDevice(name=f"{CUDA}:{index}", model=model, memory_bytes=memory), lock_name=f"gpu-{uuid}")
        for index, (model, memory, uuid) in enumerate(json.loads(answer))
    )


def lock_path(artifact_folder: Path, device: HostDevice) -> Path:
    """The file that is locked: of this host and of the device."""
    host = re.sub(r"[^A-Za-z0-9.-]", "-", socket.gethostname()) or "host"
    return artifact_folder / LOCK_FOLDER / f"{host}.{device.lock_name}.device"


class DeviceLock:
    """The lock of one device, which the process of a job shares with its worker: held until both have let go."""

    def __init__(self, artifact_folder: Path, device: HostDevice, worker: str) -> None:
        self.device, self.path = device.offered, lock_path(artifact_folder, device)
        self._worker = worker
        self._file: IO[str] | None = None

    def take(self) -> bool:
        """Whether the device is held now. Raises OSError."""
        if self._file is not None:
            return True
        self.path.parent.mkdir(parents=True, exist_ok=True)
        file = self.path.open("a+")
        if not try_lock(file):
            file.close()
            return False
        file.truncate(0)
        file.write(f"{os.getpid()} {self._worker}\n")
        file.flush()
        self._file = file
        return True

    def fileno(self) -> int:
        """The descriptor for the process of the job, which inherits the lock by it."""
        assert self._file is not None
        return self._file.fileno()

    def release(self) -> None:
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            self._file = None


_CHECKED_FOR_S = 2.0  # how long an artifact folder counts as the right one

_log = logging.getLogger("ultragray.jobs")


class Gate:
    """Opens for one job at a time, and only while this worker can do it: one that waits leaves the jobs to others.

    The artifact folder must be the one that the jobs belong to, and a device that fits a waiting job the worker's own.
    """

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
            for key in self._waiting():
                fitting[key] = {device.name for device in self.offer.fitting(demand_of_key(key))}
        wanted = set().union(*fitting.values())  # which one it will be is known when the job is
        devices = {name for name, lock in self._locks.items() if name in wanted and self._takes(lock)}
        if not devices:
            self.close()
        return [key for key, names in fitting.items() if names & devices]

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
