"""Supervision of one job: starts its process, watches it and the queue, and reports how the job ended."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

from dbos import WorkflowStatus

from ultragray.errors import MemoryExceeded

from ...claims import is_no_room
from ...errors import DatabaseUnavailable, SceneExists, StorageFull
from ..folder import JobFolder, Outcome, Request
from ..publication import publish_scene, withdraw_scene
from ..queue import database
from ..queue.database import JobDatabase
from ..specification import value_in
from .run_job import STOPPED, STORAGE_FULL

WATCH_INTERVAL_S = 0.25
_POLL_INTERVAL_S = 0.05
_STOP_WAIT_S = 10.0  # for the checkpoint of a training that is to stop
# A job fails after so many deaths of its process without progress in between. Kills from outside are hardly the job's
# fault, so more of them are allowed.
MAX_CRASHES, MAX_KILLS = 3, 20
_RESERVE_BYTES = 2**19

_log = logging.getLogger("ultragray.jobs")


@dataclass(frozen=True)
class WorkerConfig:
    """Settings of a worker, most of them for the processes of its jobs."""

    artifact_folder: Path
    executor: str  # name of the worker, the same after a restart
    device: str = "auto"
    threads: int = 1
    nice: int = 10


class Interrupted(Exception):
    """The job is cancelled, another worker's, or back in the queue: this worker must not write its end."""


class Supervisor:
    """Does the jobs of a worker, one at a time."""

    def __init__(self, config: WorkerConfig, jobs: JobDatabase) -> None:
        self._config, self._database = config, jobs
        self._stop = threading.Event()
        self._idle = threading.Event()
        self._idle.set()
        self.job_at_hand: str | None = None

    def stop(self) -> None:
        """Ends the process at hand, which writes a checkpoint, and puts its job back into the queue.

        Jobs that DBOS starts from now on are put back too.
        """
        self._stop.set()
        self._idle.wait(_STOP_WAIT_S + 5.0)

    def supervise(self, job_id: str, request: dict[str, Any]) -> Outcome:
        """Does a job, from where an earlier process left it; returns also where the job fails.

        Raises Interrupted.
        """
        self._idle.clear()
        self.job_at_hand = job_id
        try:
            row = self._require_ours(job_id)
            if self._stop.is_set():
                self._give_back(job_id)
            folder = JobFolder(self._config.artifact_folder, job_id)
            try:
                folder.path.mkdir(parents=True, exist_ok=True)
                attempt = row.recovery_attempts or 1
                kept = folder.outcome()  # of a process that finished as its worker died
                outcome = self._work(folder, request, attempt) if kept is None else replace(kept, attempts=attempt)
                made = value_in(request["specification"], "makes_scene")
                if outcome.error is None and made is not None:
                    self._require_ours(job_id)
                    self._publish(folder, made)
                    folder.remove_checkpoints()
            except SceneExists as error:
                outcome = replace(outcome, error=error.reason, reason=error.detail)  # the scene can be downloaded
            except OSError as error:
                outcome = _failure_of_storage(error)
            folder.remove_leftovers()
            _log.info(f"job {job_id} {'succeeded' if outcome.error is None else f'failed: {outcome.reason}'}")
            return outcome
        finally:
            self.job_at_hand = None
            self._idle.set()

    def _work(self, folder: JobFolder, request: dict[str, Any], attempt: int) -> Outcome:
        config = self._config
        folder.write_request(
            Request(
                specification=request["specification"],
                retry_of=request["retry_of"],
                device=config.device,
                threads=config.threads,
                nice=config.nice,
            )
        )
        crashes = kills = 0
        furthest = _furthest(folder)
        while True:
            memory_kills = _memory_kills()
            with _room_for_the_end(folder):
                code = self._run_process(folder)
            if (outcome := folder.outcome()) is not None:
                return replace(outcome, attempts=attempt)
            if code == STORAGE_FULL:
                return replace(_storage_full(), progress=folder.progress(), attempts=attempt)
            if _furthest(folder) > furthest:
                crashes = kills = 0
            furthest = max(furthest, _furthest(folder))
            is_kill = code in (-signal.SIGKILL, -signal.SIGTERM, STOPPED) and _memory_kills() == memory_kills
            kills, crashes = kills + is_kill, crashes + (not is_kill)
            _log.warning(f"the process of the job {folder.job_id} died ({_in_words(code)})")
            if kills >= MAX_KILLS or crashes >= MAX_CRASHES:
                failed = _failure_of_process(code, crashes + kills, _memory_kills() > memory_kills)
                return replace(failed, progress=folder.progress(), attempts=attempt)
            attempt += 1

    def _run_process(self, folder: JobFolder) -> int:
        """Runs the job's process to its end; its exit code. Raises Interrupted."""
        threads = str(self._config.threads)
        with folder.log.open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "ultragray_workers.jobs.worker.run_job", str(folder.path), str(os.getpid())],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={
                    **os.environ,
                    "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
                    "OMP_NUM_THREADS": threads,
                    "OPENBLAS_NUM_THREADS": threads,
                },
                start_new_session=True,
            )
        try:
            watched_at = float("-inf")
            while (code := process.poll()) is None:
                if self._stop.is_set():
                    process.terminate()
                    with suppress(subprocess.TimeoutExpired):
                        process.wait(_STOP_WAIT_S)
                    self._give_back(folder.job_id)
                if time.monotonic() - watched_at >= WATCH_INTERVAL_S:
                    with suppress(DatabaseUnavailable):  # the work goes on meanwhile
                        self._raise_unless_ours(folder.job_id)
                    watched_at = time.monotonic()
                time.sleep(_POLL_INTERVAL_S)
            return code
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def _publish(self, folder: JobFolder, scene: str) -> None:
        publish_scene(folder, scene)
        try:
            self._require_ours(folder.job_id)
        except Interrupted:
            row = self._database.workflow(folder.job_id)
            if row is None or row.status in database.CANCELLED:  # a moment before; else it is another worker's
                withdraw_scene(folder, scene)
            raise

    def _give_back(self, job_id: str) -> NoReturn:
        with suppress(DatabaseUnavailable, StorageFull):  # then the heartbeat of any worker puts it back
            self._database.put_back(job_id, self._config.executor)
        self._idle.set()
        while True:  # until this worker's process ends: a return would let DBOS take the job again
            time.sleep(_STOP_WAIT_S)

    def _require_ours(self, job_id: str) -> WorkflowStatus:
        """As `_raise_unless_ours`, but waits for a database that is away."""
        while True:
            try:
                return self._raise_unless_ours(job_id)
            except DatabaseUnavailable:
                if self._stop.wait(WATCH_INTERVAL_S):
                    self._give_back(job_id)

    def _raise_unless_ours(self, job_id: str) -> WorkflowStatus:
        """The queue's row of the job. Raises Interrupted unless it says that this worker runs it."""
        row = self._database.workflow(job_id)
        if row is None or row.status not in database.RUNNING or row.executor_id != self._config.executor:
            _log.info(f"job {job_id} is {'gone' if row is None else row.status.lower()}: its process is ended")
            raise Interrupted
        return row


@contextmanager
def _room_for_the_end(folder: JobFolder) -> Iterator[None]:
    """Reserves room on the disk for the outcome of a job that fills it, and for a queue on the same disk.

    Raises OSError.
    """
    try:
        with folder.reserve.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, _RESERVE_BYTES)
        yield
    finally:
        folder.reserve.unlink(missing_ok=True)


def _furthest(folder: JobFolder) -> int:
    progress = folder.progress()
    return (progress.step or 0) + (progress.frames_done or 0)


def _memory_kills() -> int:
    """The number of processes that the kernel killed to free memory, on this machine or in our own control group."""
    count = 0
    for path in ("/proc/vmstat", "/sys/fs/cgroup/memory.events"):
        with suppress(OSError, ValueError):
            for line in Path(path).read_text(encoding="ascii").splitlines():
                name, _, value = line.partition(" ")
                count += int(value) if name == "oom_kill" else 0
    return count


def _failure_of_process(code: int, times: int, of_memory: bool) -> Outcome:
    if of_memory:
        return Outcome(
            error=MemoryExceeded.reason,
            reason=f"the memory of the machine did not suffice: the job's process was ended {times} times",
        )
    return Outcome(
        error="INTERNAL",
        reason=f"the process of the job died {times} times without getting further ({_in_words(code)}); see its log",
    )


def _failure_of_storage(error: OSError) -> Outcome:
    if is_no_room(error):
        return _storage_full()
    return Outcome(error="INTERNAL", reason=f"the folder of the job cannot be used: {error.strerror}")


def _storage_full() -> Outcome:
    return Outcome(error=StorageFull.reason, reason="the artifact folder has no room for what this job writes")


def _in_words(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
