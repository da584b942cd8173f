"""The devices of a host: which ones a worker uses, and one job at a time on each, whichever workers share the folder.

A worker holds a device before it takes a job: those that wait for a device leave the jobs to other hosts. Free of
torch, which a process of its own asks about GPUs.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import socket
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from ultragray.errors import InvalidArgument
from ultragray.installation import memory_bytes, processor_name
from ultragray_workers.errors import StartupFailed
from ultragray_workers.jobs.demand import AUTO, CPU, CUDA, WorkerDevice, check_device

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


def devices_of(asked: str) -> tuple[HostDevice, ...]:
    """The devices of this host that auto, cpu, cuda or cuda:N means, the preferred one first.

    auto: every GPU, then the processor; cuda: every GPU. Raises StartupFailed for a GPU that is not there, and for what
    is no device.
    """
    try:
        check_device(asked)
    except InvalidArgument as error:
        raise StartupFailed(error.detail, field="device") from None
    if asked == CPU or (asked == AUTO and not any(driver.exists() for driver in _DRIVERS)):
        return (_processor(),)
    gpus = _gpus()
    if asked == AUTO:
        return (*gpus, _processor())
    chosen = tuple(gpu for gpu in gpus if asked in (CUDA, gpu.offered.name))
    if not chosen:
        there = ", ".join(gpu.offered.name for gpu in gpus) or "no GPU that torch can use"
        raise StartupFailed(f"device must be one of this host, got {asked!r}; it has {there}", field="device")
    return chosen


def _processor() -> HostDevice:
    cores = len(os.sched_getaffinity(0))
    return HostDevice(
        WorkerDevice(name=CPU, model=processor_name(), memory_bytes=memory_bytes(), cores=cores), lock_name=CPU
    )


def _gpus() -> tuple[HostDevice, ...]:
    told = subprocess.run(
        [sys.executable, "-c", _ASK_TORCH],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        stdout=subprocess.PIPE,
        timeout=_ANSWER_TIMEOUT_S,
        check=True,
    ).stdout
    return tuple(
        HostDevice(WorkerDevice(name=f"{CUDA}:{index}", model=model, memory_bytes=memory), lock_name=f"gpu-{uuid}")
        for index, (model, memory, uuid) in enumerate(json.loads(told))
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
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
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
