"""Processes of this host as the kernel tells of them: who holds a lock file, who is stopped, what one has done."""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_PROC = Path("/proc")
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Account:
    """The work of a process and its children until now."""

    cpu_s: float = 0.0
    io_bytes: int = 0
    is_ready: bool = False  # at work, or waiting for a core

    def __add__(self, other: Account) -> Account:
        return Account(self.cpu_s + other.cpu_s, self.io_bytes + other.io_bytes, self.is_ready or other.is_ready)


def account_of(pid: int) -> Account:
    """The account of a process and all below it; of one that has ended, nothing."""
    total = Account()
    with suppress(OSError, ValueError):
        state, fields = _status(pid)
        cpu_s = (int(fields[11]) + int(fields[12])) * _TICK_S  # utime, stime
        total += Account(cpu_s, _io_bytes(pid), state == "R")
        for children in (_PROC / str(pid) / "task").glob("*/children"):
            for child in children.read_text(encoding="ascii").split():
                total += account_of(int(child))
    return total


def is_stopped(pid: int) -> bool:
    """Whether a process was stopped by a signal or a debugger, and does nothing until it is let go on."""
    with suppress(OSError, ValueError):
        return _status(pid)[0] in "Tt"
    return False


def holder_of(lock: Path) -> tuple[int, str] | None:
    """The process of this host that has a lock file open, by the number that it wrote there, and the rest of the file.

    None where there is no such process: it has ended, or is another host's.
    """
    with suppress(OSError, ValueError):
        number, _, rest = lock.read_text(encoding="utf-8").strip().partition(" ")
        target = lock.resolve()
        for descriptor in (_PROC / number / "fd").iterdir():
            with suppress(OSError):
                if descriptor.resolve() == target:
                    return int(number), rest
    return None


def kill_group(pid: int) -> None:
    """Ends a process that leads a group, and all of the group; stopped ones, too."""
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)


def _io_bytes(pid: int) -> int:
    with suppress(OSError, ValueError):
        read, written = (_PROC / str(pid) / "io").read_text(encoding="ascii").splitlines()[:2]  # rchar, wchar
        return int(read.split()[1]) + int(written.split()[1])
    return 0


def _status(pid: int) -> tuple[str, list[str]]:
    """The state of a process, and the fields of its status from the state on."""
    fields = (_PROC / str(pid) / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    return fields[0], fields
