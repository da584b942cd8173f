"""Supervision of one job: starts its process, watches it and the queue, and reports how the job ended.

`worker.worker` hands it each job that it takes; `telling` lets others see how far it is. Free of torch.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NoReturn, TypeVar

from opentelemetry import propagate, trace
from opentelemetry.trace import Status, StatusCode

from ultragray.contract import made_of
from ultragray.errors import MemoryExceeded
from ultragray_workers.claims import is_no_room
from ultragray_workers.errors import (
    ArtifactFolderUnavailable,
    DatabaseUnavailable,
    JobStalled,
    JobTimeExceeded,
    SceneExists,
    StorageFull,
)
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.demand import AUTO, demand_of_key
from ultragray_workers.jobs.folder import JobFolder, Request
from ultragray_workers.jobs.kinds.base import has_checkpoints, is_in_shards
from ultragray_workers.jobs.progress import Files, Outcome
from ultragray_workers.jobs.record import Row
from ultragray_workers.jobs.worker.device import DeviceLock, Gate
from ultragray_workers.jobs.worker.process import (
    STOP_WAIT_S,
    JobTemplate,
    Watchdog,
    end_process_of_another_worker,
    end_with_checkpoint,
    job_process,
)
from ultragray_workers.jobs.worker.run_job import STOPPED, STORAGE_FULL
from ultragray_workers.jobs.worker.telling import LAST_WAIT_S, Superseded, Telling
from ultragray_workers.scene_names import SUFFIX
from ultragray_workers.scene_shelf import SCENES_FOLDER, SceneShelf
from ultragray_workers.storage.cache import DEFAULT_MAX_BYTES
from ultragray_workers.storage.storage import Storage

WATCH_INTERVAL_S = 0.25
LONGEST_SHARE_S = 60.0  # of a batch; then a share ends, where other jobs wait
STUCK_AFTER_S = 60.0  # in which the supervision itself has not moved, such as on a share that does not answer
_POLL_INTERVAL_S = 0.05
_PAUSE_S = 5.0  # before the next look for a job, after one that could not be begun or went on
# A job fails after so many deaths of its process without progress in between. Kills from outside are hardly the job's
# fault, so more of them are allowed.
MAX_CRASHES, MAX_KILLS = 3, 20
_RESERVE_BYTES = 2**19
_SAVE_RUN_TIME_EVERY_S = 5.0

_log = logging.getLogger("ultragray.jobs")
_T = TypeVar("_T")


@dataclass(frozen=True)
class WorkerConfig:
    """Settings of a worker."""

    artifact_folder: Path  # with a storage elsewhere it is this host's own, with copies of datasets
    storage: Storage  # of the files of jobs, datasets and scenes that jobs make
    database_url: str | None = None  # None: a SQLite file in the artifact folder
    name: str | None = None  # its alone; one that is started again under its name goes on with its jobs at once
    device: str = AUTO  # every GPU of the host, and its processor; cpu, cuda (every GPU) or cuda:N
    labels: Mapping[str, str] = field(default_factory=dict)  # jobs that ask for others are left to other workers
    max_copies_bytes: int = DEFAULT_MAX_BYTES  # of copies of datasets on this host
    threads: int = 0  # of a job; 0: all cores but one
    nice: int = 10
    max_footprint_pixels: int | None = None  # of a frame of a render job; None: no limit
    retention_days: float = 0.0  # then finished jobs are removed; 0: never, likewise the next
    stall_timeout_s: float = 0.0  # a job fails whose process does not get on for so long
    max_run_s: float = 0.0  # of all processes of a job
    drain_timeout_s: float = 0.0  # for a job without checkpoints to end when the worker stops


class Interrupted(Exception):
    """The job is cancelled, another worker's, or back in the queue: this worker must not write its end."""


class Supervisor:
    """Does the jobs of a worker, one at a time."""

    def __init__(self, config: WorkerConfig, jobs: JobDatabase, gate: Gate) -> None:
        self.config, self.jobs, self.gate = config, jobs, gate
        self.template = JobTemplate(config.threads)
        self.stopping = threading.Event()
        self.moved_at_s = time.monotonic()
        self.is_draining = False  # an administrator wants the job at hand to go to another worker
        self.job_at_hand: str | None = None
        self._idle = threading.Event()
        self._idle.set()
        self._stop_by_s = float("-inf")

    @property
    def is_stuck(self) -> bool:
        """Whether there is a job at hand that nobody watches: then this worker should count as dead."""
        return self.job_at_hand is not None and time.monotonic() - self.moved_at_s > STUCK_AFTER_S

    def stop(self, drain_timeout_s: float, hurry: threading.Event) -> None:
        """Ends the process at hand, which writes a checkpoint, and puts its job back into the queue.

        A job that would begin anew has `drain_timeout_s` to end first, or until `hurry` is set.
        """
        self._stop_by_s = time.monotonic() + drain_timeout_s
        self.stopping.set()
        while time.monotonic() < self._stop_by_s and not hurry.is_set() and not self._idle.wait(_POLL_INTERVAL_S):
            pass
        self._stop_by_s = float("-inf")
        self._idle.wait(STOP_WAIT_S + LAST_WAIT_S + 5.0)

    def must_stop(self, row: Row) -> bool:
        """Whether the process at hand is to end now, since its worker stops; and a sign of life of the supervision."""
        self.moved_at_s = time.monotonic()
        return self.stopping.is_set() and (has_checkpoints(row.summary) or time.monotonic() > self._stop_by_s)

    def supervise(self, row: Row) -> None:
        """Does a job that this worker has taken, from where an earlier attempt left it, and ends it in the queue.

        It stays as it is there where it is cancelled, another worker's, or put back.
        """
        self._idle.clear()
        self.moved_at_s = time.monotonic()
        self.job_at_hand = row.id
        try:
            with _span(row) as span:
                outcome = _JobAtHand(self, row).do()
                if outcome.error is not None:
                    span.set_status(Status(StatusCode.ERROR, outcome.error))
            _log.info(f"job {row.id} {'succeeded' if outcome.error is None else f'failed: {outcome.reason}'}")
        except Superseded:
            _log.info(f"another worker goes on with the job {row.id}, or it was cancelled")
        except Interrupted:
            pass
        finally:
            self.gate.close()
            self.job_at_hand = None
            self._idle.set()


class _JobAtHand:
    """One attempt at a job, from its take-over to its end."""

    def __init__(self, supervisor: Supervisor, row: Row) -> None:
        self._supervisor, self._row, self._config = supervisor, row, supervisor.config
        self._engine, self._check_storage = supervisor.jobs.engine, supervisor.jobs.identity.check
        self._folder = JobFolder(self._config.artifact_folder, row.id, row.attempt)
        self._telling = Telling(supervisor.jobs, self._config.storage, self._folder, row, self._look_after)
        self._limit_s = min(
            filter(None, [row.summary.get("max_run_s") or 0.0, self._config.max_run_s]), default=float("inf")
        )
        self._run_s, self._unsaved_s = row.run_s, 0.0
        self._device: DeviceLock

    def do(self) -> Outcome:
        """Does the job, and ends it in the queue. Raises Interrupted, Superseded."""
        with self._hold_device():
            try:
                outcome, files = self._end()
                row = self._row
                if outcome.error is not None and is_in_shards(row.summary):
                    self._ask(lambda: queue.blame_shard(self._engine, row, outcome))
                if not self._ask(lambda: queue.finish(self._engine, row, outcome, files)):
                    raise Superseded
                if is_in_shards(row.summary) and row.batch is None:
                    self._ask(lambda: queue.cancel_shares(self._engine, row.id))
                self._telling.remove_others()
                return outcome
            except Interrupted:
                self._telling.tell_last()
                raise
            finally:
                self._telling.forget()

    @contextmanager
    def _hold_device(self) -> Iterator[None]:
        """Holds a device that fits the job. Raises Interrupted where another job has it."""
        lock = None
        try:
            lock = self._supervisor.gate.hold(demand_of_key(self._row.demand))
        except OSError:
            self._require_storage()
        if lock is None:
            self._put_back(is_untouched=True)
        self._device = lock
        try:
            yield
        finally:
            lock.release()

    def _end(self) -> tuple[Outcome, Files]:
        """The end of the work, all that was made in the storage, and the scene served."""
        try:
            outcome = self._outcome() if self._is_needed() else Outcome()
            if outcome.error is not None:
                self._require_storage()
            files = self._telling.end(outcome)
            if outcome.error is None and self._row.makes_scene is not None and self._row.batch is None:
                outcome = self._publish(self._row.makes_scene, outcome, files)
            return outcome, files
        finally:
            self._save_run_time()

    def _is_needed(self) -> bool:
        """Whether the batch of a share goes on; true of all other jobs."""
        batch = self._row.batch
        row = None if batch is None else self._ask(lambda: queue.row_of(self._engine, batch))
        return batch is None or (row is not None and not row.state.is_final)

    def _outcome(self) -> Outcome:
        folder, attempt = self._folder, self._row.attempt
        try:
            self._telling.take_over()
            outcome = folder.outcome()  # of a process that finished as its worker died
            if outcome is not None:
                return replace(outcome, attempts=attempt)
            with self._telling.telling():
                return self._work()
        except (JobStalled, JobTimeExceeded) as error:
            return Outcome(error.reason, error.detail, progress=folder.progress(), attempts=attempt)
        except OSError as error:
            if is_no_room(error):
                return _STORAGE_FULL
            if attempt < MAX_KILLS:  # such as a share that has gone, and may be back by now
                self._put_back(f"its folder could not be used: {error.strerror}")
            return Outcome(error="INTERNAL", reason=f"the folder of the job cannot be used: {error.strerror}")
        finally:
            folder.remove_leftovers()

    def _work(self) -> Outcome:
        """Runs processes until one has said how the job ended, or so many have died that it failed."""
        config, folder, row = self._config, self._folder, self._row
        folder.write_request(
            made_of(
                Request,
                row,
                config,
                specification=self._ask(lambda: queue.specification_of(self._engine, row.id)),
                submitted=row.number,
                device=self._device.device.name,
                artifact_folder=str(config.artifact_folder),
                storage=config.storage.location,
                longest_share_s=LONGEST_SHARE_S,
            )
        )
        attempt, crashes, kills, furthest = row.attempt, 0, 0, _furthest(folder)
        while True:
            memory_kills = _memory_kills()
            self._ask(self._raise_unless_held)
            end_process_of_another_worker(folder)
            with _room_for_the_end(folder):
                code = self._run_process()
            if (outcome := folder.outcome()) is not None:
                return replace(outcome, attempts=attempt)
            if self._run_s >= self._limit_s:
                raise JobTimeExceeded(
                    f"the job ran for {self._limit_s:g} s, the longest that it may (its max_run_s, or "
                    "ULTRAGRAY_JOB_MAX_RUN_S); a retry goes on from its checkpoint"
                )
            self._require_storage()
            if code == STORAGE_FULL:
                return replace(_STORAGE_FULL, progress=folder.progress(), attempts=attempt)
            if _furthest(folder) > furthest:
                crashes = kills = 0
            furthest = max(furthest, _furthest(folder))
            is_of_memory = _memory_kills() > memory_kills
            is_kill = code in (-signal.SIGKILL, -signal.SIGTERM, STOPPED) and not is_of_memory
            kills, crashes = kills + is_kill, crashes + (not is_kill)
            _log.warning(f"the process of the job {row.id} died ({_in_words(code)})")
            if kills >= MAX_KILLS or crashes >= MAX_CRASHES:
                failed = _failure_of_process(code, crashes + kills, is_of_memory)
                return replace(failed, progress=folder.progress(), attempts=attempt)
            attempt += 1

    def _run_process(self) -> int:
        """Runs the job's process to its end, or to that of its time; its exit code. Raises Interrupted, JobStalled."""
        supervisor, row, config = self._supervisor, self._row, self._config
        url = supervisor.jobs.url if is_in_shards(row.summary) else None  # others do without the database
        with job_process(supervisor.template, self._folder, self._device.fileno(), url) as process:
            watchdog = Watchdog(process.pid, config.stall_timeout_s)
            watched_at_s = float("-inf")
            is_given_back = False
            try:
                while process.poll() is None:
                    if supervisor.must_stop(row):
                        end_with_checkpoint(process)
                        is_given_back = True
                        break
                    if supervisor.is_draining and has_checkpoints(row.summary):
                        end_with_checkpoint(process)
                        _log.info(f"the job {row.id} waits again: this worker is to rest")
                        self._telling.tell_last()
                        self._ask(lambda: queue.put_back(self._engine, row))
                        raise Interrupted
                    if time.monotonic() - watched_at_s >= WATCH_INTERVAL_S:
                        self._add_run_time(watchdog.look())
                        if watchdog.is_stalled:
                            raise JobStalled(
                                f"the process of the job neither computed nor read nor wrote for "
                                f"{config.stall_timeout_s:g} s and was ended; a retry goes on from its checkpoint"
                            )
                        if self._run_s >= self._limit_s:
                            end_with_checkpoint(process)
                            break
                        with suppress(DatabaseUnavailable):  # the work goes on meanwhile
                            self._raise_unless_held()
                        watched_at_s = time.monotonic()
                    with suppress(subprocess.TimeoutExpired):
                        process.wait(_POLL_INTERVAL_S)
            finally:
                self._add_run_time(watchdog.look())
            if is_given_back:
                self._telling.tell_last()
                self._give_back()
        return process.wait()

    def _publish(self, scene: str, outcome: Outcome, files: Files) -> Outcome:
        """Serves the scene, unless the job was cancelled first; how the job ended then. Raises Superseded."""
        if not self._ask(lambda: queue.publish(self._engine, self._row, outcome, files)):
            raise Superseded
        file, shelf = self._folder.artifacts / f"{scene}{SUFFIX}", SceneShelf(self._config.storage, SCENES_FOLDER)
        try:
            self._telling.patiently(lambda: shelf.publish(file, scene))
        except SceneExists as error:
            reason = f"a scene {scene!r} appeared while this job made another: choose another name"
            return replace(outcome, error=error.reason, reason=reason)  # the scene can be downloaded
        return outcome

    def _require_storage(self) -> None:
        """Puts a job back that failed because the artifact folder is gone. Raises Interrupted."""
        try:
            self._check_storage()
        except ArtifactFolderUnavailable as error:
            self._put_back(error.detail)

    def _put_back(self, why: str = "", *, is_untouched: bool = False) -> NoReturn:
        """Lets the job wait again, and this worker take none for a while. Raises Interrupted."""
        if why:
            _log.error(f"the job {self._row.id} waits again: {why}")
        self._supervisor.gate.close(for_s=_PAUSE_S)
        self._ask(lambda: queue.put_back(self._engine, self._row, is_untouched=is_untouched))
        raise Interrupted

    def _give_back(self) -> NoReturn:
        """Lets the job wait again since this worker stops. Raises Interrupted."""
        with suppress(DatabaseUnavailable, StorageFull):  # then the heartbeat of any worker puts it back
            queue.put_back(self._engine, self._row)
        raise Interrupted

    def _raise_unless_held(self) -> None:
        """Raises Interrupted unless the queue says that this worker runs the job, DatabaseUnavailable."""
        if not queue.is_held(self._engine, self._row):
            _log.info(f"job {self._row.id} is cancelled or another worker's: its process is ended")
            raise Interrupted

    def _look_after(self) -> None:
        """Keeps a job at hand whose files are on their way. Raises Interrupted where it is not ours any more."""
        if self._supervisor.must_stop(self._row):
            self._give_back()
        with suppress(DatabaseUnavailable):
            self._raise_unless_held()

    def _ask(self, question: Callable[[], _T]) -> _T:
        """The answer of a database that may be away or full for a while; a worker that stops does not wait for it."""
        while True:
            self._supervisor.moved_at_s = time.monotonic()
            try:
                return question()
            except (DatabaseUnavailable, StorageFull):
                if self._supervisor.stopping.wait(WATCH_INTERVAL_S):
                    self._give_back()

    def _add_run_time(self, seconds: float) -> None:
        self._run_s += seconds
        self._unsaved_s += seconds
        if self._unsaved_s >= _SAVE_RUN_TIME_EVERY_S:
            self._save_run_time()

    def _save_run_time(self) -> None:
        """Writes what was counted; while the database is away it is kept for the next time."""
        if self._unsaved_s:
            with suppress(DatabaseUnavailable, StorageFull):
                queue.add_run_time(self._engine, self._row, self._device.device.name, self._unsaved_s)
                self._unsaved_s = 0.0


@contextmanager
def _span(row: Row) -> Iterator[trace.Span]:
    """A span for one attempt at a job, a part of the trace of the request that submitted it."""
    attributes: dict[str, str | int] = {
        "ultragray.job": row.id,
        "ultragray.worker": row.worker or "",
        "ultragray.attempt": row.attempt,
    }
    context, kind = propagate.extract(row.trace), trace.SpanKind.CONSUMER
    tracer = trace.get_tracer("ultragray")
    with tracer.start_as_current_span(f"job {row.kind}", context, kind, attributes=attributes) as span:
        yield span


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


def _furthest(folder: JobFolder) -> tuple[int, int]:
    """How far the job is: the method at hand of a comparison, and the steps and frames that are done."""
    progress = folder.progress()
    return progress.method_number or 0, (progress.step or 0) + (progress.frames_done or 0)


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


_STORAGE_FULL = Outcome(error=StorageFull.reason, reason="the artifact folder has no room for what this job writes")


def _in_words(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
