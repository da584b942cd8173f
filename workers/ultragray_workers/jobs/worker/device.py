"""The devices of a host: which one a worker uses, and one job at a time on it, whichever workers share the folder.

A worker holds its device before it takes a job: those that wait for a device leave the jobs to other hosts. Free of
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
from functools import cache
from pathlib import Path
from typing import IO

LOCK_FOLDER = "workers"  # of the artifact folder, which several hosts may share
_DRIVERS = (Path("/dev/nvidiactl"), Path("/dev/dxg"))
_ANSWER_TIMEOUT_S = 120.0
_ASK_TORCH = """
import json, sys, torch
asked = sys.argv[1]
found = torch.cuda.device_count() if torch.cuda.is_available() else 0
index = int(asked.partition(":")[2] or 0)
device = "cpu" if asked == "auto" and not found else "cuda" if asked == "auto" else asked
known = device != "cpu" and index < found
print(json.dumps([device, str(torch.cuda.get_device_properties(index).uuid) if known else None]))
"""


@dataclass(frozen=True)
class Device:
    """A device as torch calls it on this host, and the name of its lock: the same by whatever number it is known."""

    name: str  # cpu, cuda or cuda:N
    lock_name: str


@cache
def device_of(asked: str) -> Device:
    """The device that auto, cpu, cuda or cuda:N means here; auto: a GPU where there is one."""
    if asked == "cpu" or (asked == "auto" and not any(driver.exists() for driver in _DRIVERS)):
        return Device("cpu", "cpu")
    told = subprocess.run(
        [sys.executable, "-c", _ASK_TORCH, asked],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        stdout=subprocess.PIPE,
        timeout=_ANSWER_TIMEOUT_S,
        check=True,
    ).stdout
    name, gpu = json.loads(told)
    if name == "cpu":
        return Device("cpu", "cpu")
    return Device(name, f"cuda-{name.partition(':')[2] or 0}" if gpu is None else f"gpu-{gpu}")  # None: the job fails


def lock_path(artifact_folder: Path, device: Device) -> Path:
    """The file that is locked: of this host and of the device."""
    host = re.sub(r"[^A-Za-z0-9.-]", "-", socket.gethostname()) or "host"
    return artifact_folder / LOCK_FOLDER / f"{host}.{device.lock_name}.device"


class DeviceLock:
    """The lock of one device, which the process of a job shares with its worker: held until both have let go."""

    def __init__(self, artifact_folder: Path, device: Device, worker: str) -> None:
        self.device, self.path = device, lock_path(artifact_folder, device)
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
        """Lets other workers have the device; nothing where it is not held."""
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            self._file = None
