"""A worker: takes one job at a time from the queue and supervises its process. Free of torch.

main thread: waits until it is told to stop       thread "jobs": gate → queue.take → supervision, again and again
thread "heartbeat": `jobs.workers`                thread "housekeeper": `Housekeeper`
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

from sqlalchemy.exc import SQLAlchemyError

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray_workers.claims import age_s, remove_whole, try_lock
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import StartupFailed, StorageUnavailable
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.demand import check_labels
from ultragray_workers.jobs.files import FOLDER, JobFiles
from ultragray_workers.jobs.folder import WORK
from ultragray_workers.jobs.worker.device import DeviceLock, Gate, devices_of
from ultragray_workers.jobs.worker.supervision import Supervisor, WorkerConfig
from ultragray_workers.jobs.workers import Heartbeat, Wanted
from ultragray_workers.rounds import Rounds
from ultragray_workers.storage.local import LocalStorage
from ultragray_workers.storage.storage import Storage
from ultragray_workers.store import OpenStore

POLLING_INTERVAL_S = 0.25
_NAMES_FOLDER = "workers"
_HOST_ID_FILE = "host_id"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")

_log = logging.getLogger("ultragray.jobs")


def work(
    config: WorkerConfig,
    stop: threading.Event,
    *,
    hurry: threading.Event | None = None,
    ready: Callable[[], None] = lambda: None,
    alive_every_s: float | None = None,
    tell_alive: Callable[[], None] = lambda: None,
) -> None:
    """Does jobs until `stop` is set; then the one at hand is put back into the queue with a checkpoint.

    One that has no checkpoints gets the time to drain to end first, or until `hurry` is set. `ready` is called when
    jobs are taken, and `tell_alive` every `alive_every_s` while the worker is not stuck. Raises StartupFailed.
    """
    try:
        check_labels(config.labels, "label")
    except InvalidArgument as error:
        raise StartupFailed(error.detail, field="label") from None
    devices, storage = devices_of(config.device), config.storage
    is_alone = storage.location != str(config.artifact_folder)  # workers elsewhere see it not
    with (
        contextlib.closing(OpenStore(config.artifact_folder)),
        claim_name(config.artifact_folder, config.name, host_of_its_own=is_alone) as worker,
    ):
        folder, threads = config.artifact_folder.resolve(), config.threads or max(1, (os.cpu_count() or 1) - 1)
        config = replace(config, artifact_folder=folder, threads=threads)
        jobs = JobDatabase(folder, config.database_url, storage)
        locks = [DeviceLock(folder, one, worker) for one in devices]
        labels = tuple(sorted(config.labels.items()))
        gate = Gate(jobs.identity, locks, labels, lambda: queue.demands_waiting(jobs.engine))
        supervisor = Supervisor(config, jobs, gate)

        def obey(wanted: Wanted) -> None:
            if gate.is_resting is not (wanted is not Wanted.WORK):
                _log.info(f"worker {worker} is to {wanted.value}")
            gate.is_resting = wanted is not Wanted.WORK
            supervisor.is_draining = wanted is Wanted.DRAIN

        heartbeat = Heartbeat(
            jobs.engine,
            worker,
            job_at_hand=lambda: supervisor.job_at_hand,
            is_stuck=lambda: supervisor.is_stuck,
            device=config.device,
            offer=gate.offer,
            obey=obey,
        )
        for job_id in queue.put_back_of(jobs.engine, worker):
            _log.info(f"the job {job_id} goes on: this worker had it before it died")
        thread = threading.Thread(
            target=_take_jobs, args=(jobs, worker, gate, supervisor, stop), name="jobs", daemon=True
        )
        thread.start()
        housekeeper = Housekeeper(jobs, folder, storage, config.retention_days)
        if config.retention_days:
            housekeeper.start()
        fields = {"worker": worker, "threads": threads, "offer": str(gate.offer)}
        _log.info(f"worker {worker} takes jobs", extra={"fields": fields})
        ready()
        while not stop.wait(alive_every_s):
            if not supervisor.is_stuck:
                tell_alive()
        housekeeper.stop()
        supervisor.stop(config.drain_timeout_s, hurry or threading.Event())
        thread.join(POLLING_INTERVAL_S)
        heartbeat.stop()
        jobs.close()
        _log.info(f"worker {worker} stopped")


def _take_jobs(jobs: JobDatabase, worker: str, gate: Gate, supervisor: Supervisor, stop: threading.Event) -> None:
    """Does one job after another until `stop` is set."""
    rounds = Rounds("taking jobs", _log)
    with contextlib.closing(supervisor.template) as template:
        with rounds.round():
            template.start()  # before the first job comes
        while not stop.is_set():
            with rounds.round():
                row = None
                with contextlib.suppress(UltragrayError, SQLAlchemyError):  # the heartbeat tells of a lost database
                    row = queue.take(jobs.engine, worker, gate.opens())
                if row is not None:
                    supervisor.supervise(row)
                    continue
                gate.close()
            stop.wait(POLLING_INTERVAL_S)


@contextlib.contextmanager
def claim_name(artifact_folder: Path, name: str | None, *, host_of_its_own: bool = False) -> Iterator[str]:
    """The worker's name for as long as it lives: the one given, or HOST-N with the first N that is free.

    `host_of_its_own`: the workers of other hosts, whose names may be the same, do not see the folder; then it is
    HOST-ID-N, with an id that the folder keeps. Raises StartupFailed where another worker has the name.
    """
    folder = artifact_folder / _NAMES_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    if name is not None:
        if not _NAME.fullmatch(name):
            raise StartupFailed(f"name must be letters, digits, '.', '_', '-', got {name!r}", field="name")
        candidates: Iterator[str] = iter([name])
    else:
        host = re.sub(r"[^A-Za-z0-9.-]", "-", socket.gethostname()).lstrip(".-")[:100] or "host"
        if host_of_its_own:
            host = f"{host}-{_host_id(folder)}"
        candidates = (f"{host}-{number}" for number in itertools.count())
    for candidate in candidates:
        with (folder / f"{candidate}.lock").open("a") as file:
            if not try_lock(file):
                continue
            yield candidate
            return
    raise StartupFailed(f"another worker is called {name!r}: give this one another name", field="name")


def _host_id(folder: Path) -> str:
    """The id of this host among those that share a storage, the same after a restart."""
    storage = LocalStorage(folder)
    storage.write(_HOST_ID_FILE, secrets.token_hex(3).encode(), if_absent=True)
    return storage.read(_HOST_ID_FILE).decode("ascii")


INTERVAL_S = 3600.0
STEP_PAUSE_S = 1.0
AT_ONCE = 20  # jobs of one step
DAY_S = 86_400.0
_JOB_ID = re.compile(r"[0-9a-f]{24}(-[0-9a-f]{8})?")  # of a job, or a share of it


class Housekeeper:
    """Removes jobs that finished more than `retention_days` ago, every hour."""

    def __init__(self, jobs: JobDatabase, artifact_folder: Path, storage: Storage, retention_days: float) -> None:
        """`artifact_folder`: of this host, in which jobs are worked at; `storage`: of their files."""
        self._engine, self._artifact_folder, self._storage = jobs.engine, artifact_folder, storage
        self._files = JobFiles(storage, lambda job_id: queue.row_of(jobs.engine, job_id), artifact_folder)
        self._retention_s = retention_days * DAY_S
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="housekeeper", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()

    def keep_house(self) -> int:
        """One round: how many jobs and folders were removed. Raises UltragrayError where the database is away."""
        removed, kept = 0, set[str]()
        while not self._stop.is_set():
            if not (old := queue.finished_ago(self._engine, self._retention_s, kept, AT_ONCE)):
                break
            for job_id in old:
                try:
                    self._files.remove(job_id)
                    queue.forget(self._engine, job_id)
                    removed += 1
                except (StorageUnavailable, OSError):
                    kept.add(job_id)
            self._stop.wait(STEP_PAUSE_S)
        removed += self._remove_unknown(self._stored_ids(), self._files.remove)
        folders = {path.name: path for path in (self._artifact_folder / WORK).glob("*") if age_s(path) > DAY_S}
        by_id = {name.partition(".")[0]: path for name, path in folders.items()}
        removed += self._remove_unknown(by_id, lambda job_id: remove_whole(by_id[job_id]))
        return removed + DatasetStore(self._artifact_folder, self._storage).remove_stray_files()

    def _stored_ids(self) -> Iterable[str]:
        """The jobs of whose files the newest is a day old."""
        newest: dict[str, float] = {}
        for entry in self._storage.entries(FOLDER):
            job_id = entry.key.split("/")[1]
            newest[job_id] = max(entry.modified, newest.get(job_id, 0.0))
        return [job_id for job_id, modified in newest.items() if time.time() - modified > DAY_S]

    def _remove_unknown(self, ids: Iterable[str], remove: Callable[[str], None]) -> int:
        """Removes what there is of jobs that the queue does not know."""
        removed, rest = 0, iter([job_id for job_id in ids if _JOB_ID.fullmatch(job_id)])
        while not self._stop.is_set() and (some := list(islice(rest, AT_ONCE))):
            for job_id in set(some) - queue.known_ids(self._engine, some):
                remove(job_id)
                removed += 1
            self._stop.wait(STEP_PAUSE_S)
        return removed

    def _run(self) -> None:
        rounds = Rounds("the removal of old jobs", _log)
        while not self._stop.is_set():
            with rounds.round():
                try:
                    if removed := self.keep_house():
                        _log.info(f"removed {removed} old jobs")
                except (UltragrayError, SQLAlchemyError, OSError) as error:
                    _log.warning(f"old jobs are kept for now: {str(error).splitlines()[0]}")
            self._stop.wait(INTERVAL_S)
