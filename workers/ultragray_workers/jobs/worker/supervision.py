"""Supervision of one job: starts its process, watches it and the queue, and reports how the job ended."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from dbos import WorkflowStatus
from opentelemetry.trace import Status, StatusCode

from ultragray.errors import MemoryExceeded
from ultragray_workers.claims import is_no_room
from ultragray_workers.datasets.copies import DEFAULT_MAX_BYTES
from ultragray_workers.errors import (
    ArtifactFolderUnavailable,
    DatabaseUnavailable,
    JobStalled,
    JobTimeExceeded,
    SceneExists,
    StorageFull,
)
from ultragray_workers.jobs.folder import FOLDER, JobFolder, Outcome, Request
from ultragray_workers.jobs.matching.demand import Demand
from ultragray_workers.jobs.publication import give_name_back, publish_scene
from ultragray_workers.jobs.queue import database, runs
from ultragray_workers.jobs.queue.database import JobDatabase
from ultragray_workers.jobs.shards.desk import BatchOver, ShardDesk
from ultragray_workers.jobs.shards.shares import SHARE_OF, cancel_shares
from ultragray_workers.jobs.shared.record import Superseded
from ultragray_workers.jobs.specification import has_checkpoints, is_in_shards, value_in
from ultragray_workers.jobs.tracing import job_span
from ultragray_workers.jobs.worker.device import DeviceLock
from ultragray_workers.jobs.worker.gate import Gate
from ultragray_workers.jobs.worker.job_process import (
    STOP_WAIT_S,
    end_process_of_another_worker,
    end_with_checkpoint,
    job_process,
)
from ultragray_workers.jobs.worker.run_job import STOPPED, STORAGE_FULL
from ultragray_workers.jobs.worker.run_time import RunTime
from ultragray_workers.jobs.worker.sharing import LAST_WAIT_S, InOneFolder, Sharing, ThroughStorage
from ultragray_workers.jobs.worker.watchdog import Watchdog
from ultragray_workers.scenes import SUFFIX
from ultragray_workers.storage.storage import Storage

WATCH_INTERVAL_S = 0.25
STUCK_AFTER_S = 60.0  # in which the supervision itself has not moved, such as on a share that does not answer
_POLL_INTERVAL_S = 0.05
_PAUSE_S = 5.0  # before the next look for a job, after one that could not be begun or went on
# A job fails after so many deaths of its process without progress in between. Kills from outside are hardly the job's
# fault, so more of them are allowed.
MAX_CRASHES, MAX_KILLS = 3, 20
_ROW_WAIT_S = 5.0
_RESERVE_BYTES = 2**19

_log = logging.getLogger("ultragray.jobs")
_T = TypeVar("_T")


@dataclass(frozen=True)
class WorkerConfig:
    """Settings of a worker, most of them for the processes of its jobs."""

    artifact_folder: Path
    executor: str  # name of the worker, the same after a restart
    shared: Storage | None = None  # where several hosts have the files of jobs; None: in the artifact folder
    max_copies_bytes: int = DEFAULT_MAX_BYTES  # of shared datasets on this host
    threads: int = 1
    nice: int = 10
    max_footprint_pixels: int | None = None  # of a frame of a render job; None: no limit
    stall_timeout_s: float = 0.0  # 0: no limit; likewise the next
    max_run_s: float = 0.0


class Interrupted(Exception):
    """The job is cancelled, another worker's, or back in the queue: this worker must not write its end."""


class Supervisor:
    """Does the jobs of a worker, one at a time."""

    def __init__(self, config: WorkerConfig, jobs: JobDatabase, gate: Gate) -> None:
        self._config, self._database, self._gate = config, jobs, gate
        self._stop = threading.Event()
        self._idle = threading.Event()
        self._idle.set()
        self._moved_at_s = time.monotonic()
        self._stop_by_s = float("-inf")
        self._goes_on_elsewhere = False  # the job at hand, from its checkpoint
        self.is_draining = False  # an administrator wants the job at hand to go to another worker
        self.job_at_hand: str | None = None
        self._desk: ShardDesk | None = None  # of a job in shards
        self._sharing: Sharing | None = None  # of the job at hand

    @property
    def is_stuck(self) -> bool:
        """Whether there is a job at hand that nobody watches: then this worker should count as dead."""
        return self.job_at_hand is not None and time.monotonic() - self._moved_at_s > STUCK_AFTER_S

    def stop(self, drain_timeout_s: float, hurry: threading.Event) -> None:
        """Ends the process at hand, which writes a checkpoint, and puts its job back into the queue.

        A job that would begin anew has `drain_timeout_s` to end first, or until `hurry` is set. Jobs that DBOS starts
        from now on are put back too.
        """
        job_id = self.job_at_hand
        self._stop_by_s = time.monotonic() + drain_timeout_s
        self._stop.set()
        while time.monotonic() < self._stop_by_s and not hurry.is_set() and not self._idle.wait(_POLL_INTERVAL_S):
            pass
        self._stop_by_s = float("-inf")
        if self._idle.wait(STOP_WAIT_S + LAST_WAIT_S + 5.0) and job_id is not None:
            self._wait_for_the_row(job_id)

    def _wait_for_the_row(self, job_id: str) -> None:
        """Waits until the queue has the end of a job, which DBOS writes after `supervise` has returned it."""
        end_s = time.monotonic() + _ROW_WAIT_S
        while time.monotonic() < end_s:
            with suppress(DatabaseUnavailable):
                row = self._database.workflow(job_id)
                if row is None or row.status not in database.RUNNING or row.executor_id != self._config.executor:
                    return
            time.sleep(_POLL_INTERVAL_S)

    def supervise(self, job_id: str, request: dict[str, Any]) -> Outcome:
        """Does a job, from where an earlier process left it; returns also where the job fails.

        Raises Interrupted.
        """
        self._idle.clear()
        self._moved_at_s = time.monotonic()
        self._goes_on_elsewhere = has_checkpoints(request["specification"])
        self.job_at_hand = job_id
        try:
            row = self._require_ours(job_id)
            if self._stop.is_set():
                self._give_back(job_id)
            if SHARE_OF in request and not self._goes_on(request[SHARE_OF]):
                return Outcome()
            with (
                self._device_for(job_id, request["specification"]) as device,
                job_span(row, self._config.executor) as span,
            ):
                outcome = self._outcome_of(row, request, device)
                if outcome.error is not None:
                    span.set_status(Status(StatusCode.ERROR, outcome.error))
            if outcome.error is not None:
                self._require_folder(job_id)
                self._give_name_back(row, request["specification"])
                if self._desk is not None:
                    self._until_the_database_answers(job_id, partial(self._desk.fail, outcome))
            if is_in_shards(request["specification"]):
                self._end_shares(job_id, request)
            _log.info(f"job {job_id} {'succeeded' if outcome.error is None else f'failed: {outcome.reason}'}")
            return outcome
        except Superseded:
            _log.info(f"another worker goes on with the job {job_id}")
            raise Interrupted from None
        finally:
            if self._sharing is not None:
                self._sharing.forget()
                self._sharing = None
            self._gate.close()
            self.job_at_hand = self._desk = None
            self._idle.set()

    def _outcome_of(self, row: WorkflowStatus, request: dict[str, Any], device: DeviceLock) -> Outcome:
        job_id, specification, attempt = row.workflow_id, request["specification"], row.recovery_attempts or 1
        folder = JobFolder(self._config.artifact_folder, job_id)
        made = value_in(specification, "makes_scene")
        sharing = self._sharing = self._sharing_of(folder, request, attempt)
        try:
            end_process_of_another_worker(folder)
            sharing.take_over()
            kept = folder.outcome()  # of a process that finished as its worker died
            if kept is None:
                with sharing.telling():
                    outcome = self._work(folder, row, request, device)
            else:
                outcome = replace(kept, attempts=attempt)
            if outcome.error is None and made is not None:
                sharing.end(outcome)  # first: a worker that goes on from here serves the scene
                self._publish(folder, made, sharing)
                folder.remove_checkpoints()
        except SceneExists as error:
            outcome = replace(outcome, error=error.reason, reason=error.detail)  # the scene can be downloaded
        except (JobStalled, JobTimeExceeded) as error:
            outcome = Outcome(error.reason, error.detail, progress=folder.progress(), attempts=attempt)
        except OSError as error:
            if not is_no_room(error) and attempt < MAX_KILLS:  # such as a share that has gone, and may be back by now
                self._put_back(job_id, f"its folder could not be used: {error.strerror}")
            outcome = _failure_of_storage(error)
        folder.remove_leftovers()
        sharing.end(outcome)
        return outcome

    def _sharing_of(self, folder: JobFolder, request: dict[str, Any], attempt: int) -> Sharing:
        needed = value_in(request["specification"], "needs_scene")
        file, submission = needed and f"{needed}{SUFFIX}", request.get("submission")
        if self._config.shared is None:
            return InOneFolder(folder, submission, file)
        return ThroughStorage(
            self._config.shared,
            folder,
            submission=submission,
            attempt=attempt,
            needed=file,
            retry_of=request["retry_of"],
            watch=lambda: self._look_after(folder.job_id),
            is_in_shards=is_in_shards(request["specification"]),
        )

    def _look_after(self, job_id: str) -> None:
        """Keeps a job at hand whose files are on their way. Raises Interrupted where it is not ours any more."""
        self._moved_at_s = time.monotonic()
        if self._stop.is_set():
            self._give_back(job_id)
        with suppress(DatabaseUnavailable):
            self._raise_unless_ours(job_id)

    @contextmanager
    def _device_for(self, job_id: str, specification: dict[str, Any]) -> Iterator[DeviceLock]:
        """A device that fits a job, held; the gate holds one, but not for a job that this worker had before it died.

        Raises Interrupted where another job has it, or this worker offers none any more.
        """
        lock = None
        try:
            lock = self._gate.hold(Demand.of(specification))
        except OSError:
            self._require_folder(job_id)
        if lock is None:
            self._gate.close(for_s=_PAUSE_S)
            self._until_the_database_answers(job_id, lambda: self._database.take_back(job_id, self._config.executor))
            raise Interrupted
        try:
            yield lock
        finally:
            lock.release()

    def _work(self, folder: JobFolder, row: WorkflowStatus, request: dict[str, Any], device: DeviceLock) -> Outcome:
        config, specification = self._config, request["specification"]
        run_time = self._until_the_database_answers(
            folder.job_id,
            lambda: RunTime(
                self._database,
                folder.job_id,
                row.authenticated_user,
                device.device.name,
                [specification.get("max_run_s") or 0.0, config.max_run_s],
            ),
        )
        folder.write_request(
            Request(
                specification=specification,
                retry_of=request["retry_of"],
                submission=request.get("submission"),
                device=device.device.name,
                threads=config.threads,
                nice=config.nice,
                max_footprint_pixels=config.max_footprint_pixels,
                storage=None if config.shared is None else config.shared.location,
                max_copies_bytes=config.max_copies_bytes,
            )
        )
        attempt = row.recovery_attempts or 1
        crashes = kills = 0
        furthest = _furthest(folder)
        while True:
            memory_kills = _memory_kills()
            self._require_ours(folder.job_id)
            end_process_of_another_worker(folder)
            with _room_for_the_end(folder):
                code = self._run_process(folder, row, request, device, run_time)
            if (outcome := folder.outcome()) is not None:
                return replace(outcome, attempts=attempt)
            if run_time.is_over:
                raise JobTimeExceeded(
                    f"the job ran for {run_time.limit_s:g} s, the longest that it may (its max_run_s, or "
                    "ULTRAGRAY_JOB_MAX_RUN_S); a retry goes on from its checkpoint"
                )
            self._require_folder(folder.job_id)
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

    @contextmanager
    def _desk_for(self, row: WorkflowStatus, request: dict[str, Any]) -> Iterator[ShardDesk | None]:
        """The desk of a process at a job in shards."""
        if not is_in_shards(request["specification"]):
            yield None
            return
        desk = self._desk = self._until_the_database_answers(
            row.workflow_id, lambda: ShardDesk(self._database, row, request)
        )
        try:
            yield desk
        except BatchOver:
            _log.info(f"the batch of {row.workflow_id} is over: its process is ended")
            raise Interrupted from None
        finally:
            desk.close()

    def _goes_on(self, batch: str) -> bool:
        """Whether a batch waits or runs."""
        row = self._until_the_database_answers(batch, lambda: self._database.workflow(batch))
        return row is not None and row.status in (*database.QUEUED, *database.RUNNING)

    def _end_shares(self, job_id: str, request: dict[str, Any]) -> None:
        """Ends the shares of a batch that has ended; of a share, removes its folder."""
        if SHARE_OF in request:
            shutil.rmtree(self._config.artifact_folder / FOLDER / job_id, ignore_errors=True)
        else:
            self._until_the_database_answers(job_id, lambda: cancel_shares(self._database, job_id))

    def _run_process(
        self,
        folder: JobFolder,
        row: WorkflowStatus,
        request: dict[str, Any],
        device: DeviceLock,
        run_time: RunTime,
    ) -> int:
        """Runs the job's process to its end, or to that of its time; its exit code. Raises Interrupted, JobStalled."""
        with (
            self._desk_for(row, request) as desk,
            job_process(folder, device, self._config.threads, desk.descriptors if desk else ()) as process,
        ):
            watchdog = Watchdog(process.pid, self._config.stall_timeout_s)
            watched_at_s = float("-inf")
            is_given_back = False
            try:
                while process.poll() is None:
                    if self._stop.is_set() and (self._goes_on_elsewhere or time.monotonic() > self._stop_by_s):
                        end_with_checkpoint(process)
                        is_given_back = True
                        break
                    if self.is_draining and self._goes_on_elsewhere:
                        end_with_checkpoint(process)
                        self._leave_to_others(folder.job_id)
                    if time.monotonic() - watched_at_s >= WATCH_INTERVAL_S:
                        run_time.add(watchdog.look())
                        if watchdog.is_stalled:
                            raise JobStalled(
                                f"the process of the job neither computed nor read nor wrote for "
                                f"{self._config.stall_timeout_s:g} s and was ended; a retry goes on from its checkpoint"
                            )
                        if run_time.is_over:
                            end_with_checkpoint(process)
                            break
                        with suppress(DatabaseUnavailable):  # the work goes on meanwhile
                            self._raise_unless_ours(folder.job_id)
                        watched_at_s = time.monotonic()
                    self._moved_at_s = time.monotonic()
                    if desk is None:
                        time.sleep(_POLL_INTERVAL_S)
                    else:
                        desk.attend(_POLL_INTERVAL_S)
            finally:
                run_time.add(watchdog.look())
                run_time.save()
            if desk is not None:
                desk.settle()
            if is_given_back:
                self._give_back(folder.job_id)
        return process.returncode

    def _publish(self, folder: JobFolder, scene: str, sharing: Sharing) -> None:
        """Serves the scene, unless the job was cancelled first: from here on it cannot be. Raises Interrupted."""

        def decide() -> bool:
            self._raise_unless_ours(folder.job_id)
            return runs.decide(self._database.engine, folder.job_id, runs.PUBLISHED)

        if not self._until_the_database_answers(folder.job_id, decide):
            cancel = self._database.client.cancel_workflow  # again: whoever decided it may have died before
            self._until_the_database_answers(folder.job_id, lambda: cancel(folder.job_id))
            raise Interrupted
        shared = () if self._config.shared is None else (self._config.shared,)
        sharing.patiently(lambda: publish_scene(folder, scene, *shared))

    def _give_name_back(self, row: WorkflowStatus, specification: dict[str, Any]) -> None:
        """Lets others have the name of the scene that a job was to make and did not."""
        if (scene := value_in(specification, "makes_scene")) is not None:
            folder = JobFolder(self._config.artifact_folder, row.workflow_id)
            user, shared = row.authenticated_user, self._config.shared
            give = partial(give_name_back, self._database, folder, scene, user, shared)
            give_at_last = partial(self._until_the_database_answers, row.workflow_id, give)
            assert self._sharing is not None  # of the job whose end this is
            self._sharing.patiently(give_at_last)

    def _require_folder(self, job_id: str) -> None:
        """Puts a job back that failed because its folder is gone. Raises Interrupted."""
        try:
            self._gate.folder.check()
        except ArtifactFolderUnavailable as error:
            self._put_back(job_id, error.detail)

    def _put_back(self, job_id: str, why: str) -> NoReturn:
        _log.error(f"the job {job_id} waits again: {why}")
        self._gate.close(for_s=_PAUSE_S)
        self._until_the_database_answers(job_id, lambda: self._database.put_back(job_id, self._config.executor))
        raise Interrupted

    def _leave_to_others(self, job_id: str) -> NoReturn:
        """Puts the job at hand back into the queue. Raises Interrupted."""
        _log.info(f"the job {job_id} waits again: this worker is to rest")
        self._tell_last()
        self._until_the_database_answers(job_id, lambda: self._database.put_back(job_id, self._config.executor))
        raise Interrupted

    def _tell_last(self) -> None:
        if self._sharing is not None:
            self._sharing.tell_last()

    def _give_back(self, job_id: str) -> NoReturn:
        self._tell_last()
        with suppress(DatabaseUnavailable, StorageFull):  # then the heartbeat of any worker puts it back
            self._database.put_back(job_id, self._config.executor)
        self._idle.set()
        while True:  # until this worker's process ends: a return would let DBOS take the job again
            time.sleep(STOP_WAIT_S)

    def _require_ours(self, job_id: str) -> WorkflowStatus:
        """As `_raise_unless_ours`, but waits for a database that is away."""
        return self._until_the_database_answers(job_id, lambda: self._raise_unless_ours(job_id))

    def _until_the_database_answers(self, job_id: str, ask: Callable[[], _T]) -> _T:
        """The answer of a database that may be away for a while; a worker that is to stop does not wait for it."""
        while True:
            self._moved_at_s = time.monotonic()
            try:
                return ask()
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


def _failure_of_storage(error: OSError) -> Outcome:
    if is_no_room(error):
        return _storage_full()
    return Outcome(error="INTERNAL", reason=f"the folder of the job cannot be used: {error.strerror}")


def _storage_full() -> Outcome:
    return Outcome(error=StorageFull.reason, reason="the artifact folder has no room for what this job writes")


def _in_words(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
