"""The process of a job: forked, ended with a checkpoint, never left behind, and watched by what the kernel tells.

`supervision` has it forked by the worker's `template` and decides about it; `run_job` is what runs in it. Free of
torch.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from ultragray_workers.jobs.folder import JobFolder

DATABASE_VARIABLE = "JOBS_DATABASE_URL"  # of the environment of a job's process
STOP_WAIT_S = 10.0  # for the checkpoint of a training that is to stop
_KILL_WAIT_S, _KILL_POLL_S = 5.0, 0.02
_PROC = Path("/proc")
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
PID, EXIT_CODE, MAX_ANSWER_BYTES = b"pid", b"exit", 32  # of the answers of a template
LEAST_CPU_S = 0.1  # of a process that gets on; waiting with a look now and then takes less
LONGEST_STEP_S = 2.0  # between two looks; what is longer, this worker itself was stopped for


class JobTemplate:
    """The process that forks those of a worker's jobs (`worker.template`), started again where it has died.

    Its methods belong to one thread, with whose end the kernel ends it, too.
    """

    def __init__(self, threads: int) -> None:
        """`threads`: of a job."""
        self._threads = threads
        self._process: subprocess.Popen[bytes] | None = None
        self._requests: socket.socket | None = None

    def start(self) -> None:
        """Start it, unless it lives; it is ready some seconds later, for which `fork` waits."""
        if self._process is not None and self._process.poll() is None:
            return
        self.close()
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with far:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "ultragray_workers.jobs.worker.template", str(far.fileno())],
                stdin=subprocess.DEVNULL,
                env={
                    **os.environ,
                    "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
                    "OMP_NUM_THREADS": str(self._threads),
                    "OPENBLAS_NUM_THREADS": "1",  # it starts its threads on import: a process with any must not fork
                },
                start_new_session=True,
                pass_fds=[far.fileno()],
            )
        self._requests = near

    def fork(self, folder: JobFolder, device_lock: int, environment: Mapping[str, str]) -> JobProcess:
        """A process at work in the folder, which inherits the lock of its device; it leads a group."""
        self.start()
        assert self._process is not None
        assert self._requests is not None
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        request = {"folder": str(folder.path), "environment": dict(environment)}
        with folder.log.open("ab") as log, far, suppress(BrokenPipeError, ConnectionResetError):  # it has just died
            descriptors = [log.fileno(), device_lock, far.fileno()]
            socket.send_fds(self._requests, [json.dumps(request).encode()], descriptors)
        return JobProcess(near, self._process)

    def close(self) -> None:
        """End it; no job may be at work."""
        if self._requests is not None:
            self._requests.close()
            self._requests = None
        if self._process is not None:
            kill_group(self._process.pid)
            self._process.wait()
            self._process = None


class JobProcess:
    """A process that the template has forked, with the methods of subprocess.Popen that are used of one."""

    def __init__(self, answers: socket.socket, template: subprocess.Popen[bytes]) -> None:
        """Waits until it is there, or has died before it could say so."""
        self.pid: int | None = None
        self.returncode: int | None = None
        self._answers, self._template = answers, template
        self._take_answer()

    def poll(self) -> int | None:
        with suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout_s: float | None = None) -> int:
        """The exit code. Raises subprocess.TimeoutExpired."""
        if self.returncode is None:
            if not select.select([self._answers], [], [], timeout_s)[0]:
                raise subprocess.TimeoutExpired("the process of a job", timeout_s or 0.0)
            self._take_answer()
        assert self.returncode is not None
        return self.returncode

    def terminate(self) -> None:
        if self.poll() is None and self.pid is not None:
            os.kill(self.pid, signal.SIGTERM)

    def end(self) -> None:
        """Kill it with its group."""
        if self.pid is not None:
            kill_group(self.pid)
        self.wait()
        self._answers.close()

    def _take_answer(self) -> None:
        """Waits for the process's number, or for its end, which is the template's where that has died."""
        answer = b""
        with suppress(ConnectionResetError):
            answer = self._answers.recv(MAX_ANSWER_BYTES)
        kind, _, number = answer.partition(b" ")
        if kind == PID:
            self.pid = int(number)
        else:
            self.returncode = int(number) if kind == EXIT_CODE else self._template.wait()


@contextmanager
def job_process(
    template: JobTemplate, folder: JobFolder, device_lock: int, database_url: str | None
) -> Iterator[JobProcess]:
    """A process at work in the folder, which inherits the lock of its device; killed with its group at the end.

    `database_url`: of the jobs, for one that takes shards; it may hold a password, and so stands in no file.
    """
    environment = {} if database_url is None else {DATABASE_VARIABLE: database_url}
    process = template.fork(folder, device_lock, environment)
    try:
        yield process
    finally:
        process.end()


def end_with_checkpoint(process: JobProcess) -> None:
    """Asks a process to write a checkpoint and end, and waits for a while."""
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(STOP_WAIT_S)


def end_process_of_another_worker(folder: JobFolder) -> None:
    """Kills the process of a worker of this host that has lost the job, but lives or was stopped."""
    end_s = time.monotonic() + _KILL_WAIT_S
    while (holder := holder_of(folder.lock)) is not None and time.monotonic() < end_s:
        kill_group(holder[0])
        time.sleep(_KILL_POLL_S)


class Watchdog:
    """Looks at one process now and then: whether it gets on, and how long it has run.

    Getting on is told by the kernel's account of the process, not by the job: loading a dataset, evaluating and writing
    an archive take the processor or move bytes like any training step does, however long one takes. A process that is
    stopped or waits for something that never comes does neither. One that computes for ever is ended by its longest
    time.
    """

    def __init__(self, pid: int | None, stall_timeout_s: float) -> None:
        """`pid`: None where there is no process to look at, as the one that was to fork it has died."""
        self._pid, self._stall_timeout_s = pid, stall_timeout_s
        self._looked_at_s = time.monotonic()
        self._at_last_sign = Account()
        self._idle_s = 0.0

    @property
    def is_stalled(self) -> bool:
        """Whether the process has not got on for the whole timeout."""
        return 0.0 < self._stall_timeout_s <= self._idle_s

    def look(self) -> float:
        """Looks at the process; the seconds since the last look, as far as this worker was there to see."""
        now_s = time.monotonic()
        passed_s = min(LONGEST_STEP_S, now_s - self._looked_at_s)
        self._looked_at_s = now_s
        account = Account() if self._pid is None else account_of(self._pid)
        before = self._at_last_sign
        if (
            account.is_ready
            or account.io_bytes != before.io_bytes
            or not 0.0 <= account.cpu_s - before.cpu_s < LEAST_CPU_S  # less than before: a child has ended
        ):
            self._at_last_sign, self._idle_s = account, 0.0
        else:
            self._idle_s += passed_s
        return passed_s


@dataclass(frozen=True)
class Account:
    """The work of a process and its children until now."""

    cpu_s: float = 0.0
    io_bytes: int = 0
    is_ready: bool = False  # at work, or waiting for a core


def account_of(pid: int) -> Account:
    """The account of a process and all below it; of one that has ended, nothing."""
    ticks, io_bytes, is_ready, pids = 0, 0, False, [pid]
    for one in pids:  # children are added on the way
        with suppress(OSError, ValueError):
            state, fields = _status(one)
            ticks += int(fields[11]) + int(fields[12])  # utime, stime
            io_bytes += _io_bytes(one)
            is_ready |= state == "R"
            for children in (_PROC / str(one) / "task").glob("*/children"):
                pids += map(int, children.read_text(encoding="ascii").split())
    return Account(ticks * _TICK_S, io_bytes, is_ready)


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
