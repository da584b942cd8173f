"""A worker: takes one job at a time from the queue and supervises its process. Free of torch."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import logging
import os
import re
import secrets
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from dbos import DBOS, PortableWorkflowError, WorkflowSerializationFormat

from ultragray.errors import InvalidArgument
from ultragray_workers.datasets.copies import DEFAULT_MAX_BYTES
from ultragray_workers.errors import StartupFailed
from ultragray_workers.jobs.kinds import KINDS
from ultragray_workers.jobs.matching.demand import check_labels
from ultragray_workers.jobs.queue import database, unfinished
from ultragray_workers.jobs.queue.database import JobDatabase, dbos_config, quiet_dbos
from ultragray_workers.jobs.queue.heartbeat import Heartbeat
from ultragray_workers.jobs.queue.internals import NotMine, leave_others_room, take_only_through
from ultragray_workers.jobs.queue.wishes import Wanted
from ultragray_workers.jobs.shards.shares import SHARE
from ultragray_workers.jobs.worker.device import DeviceLock, devices_of
from ultragray_workers.jobs.worker.gate import Gate
from ultragray_workers.jobs.worker.housekeeping import Housekeeper
from ultragray_workers.jobs.worker.supervision import Interrupted, Supervisor, WorkerConfig
from ultragray_workers.storage.local import LocalStorage
from ultragray_workers.storage.storage import Storage
from ultragray_workers.store import OpenStore

POLLING_INTERVAL_S = 0.25
_NAMES_FOLDER = "workers"
_HOST_ID_FILE = "host_id"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")

_log = logging.getLogger("ultragray.jobs")


def work(
    artifact_folder: Path,
    database_url: str | None,
    stop: threading.Event,
    *,
    shared: Storage | None = None,
    max_copies_bytes: int = DEFAULT_MAX_BYTES,
    hurry: threading.Event | None = None,
    name: str | None = None,
    device: str = "auto",
    labels: Mapping[str, str] = MappingProxyType({}),
    threads: int = 0,
    nice: int = 10,
    max_footprint_pixels: int | None = None,
    retention_days: float = 0.0,
    stall_timeout_s: float = 0.0,
    max_run_s: float = 0.0,
    drain_timeout_s: float = 0.0,
    ready: Callable[[], None] = lambda: None,
    alive_every_s: float | None = None,
    tell_alive: Callable[[], None] = lambda: None,
) -> None:
    """Does jobs until `stop` is set; then the one at hand is put back into the queue with a checkpoint.

    One that has no checkpoints gets `drain_timeout_s` to end first, or until `hurry` is set. `ready` is called when
    jobs are taken, and `tell_alive` every `alive_every_s` while the worker is not stuck.

    `device`: auto (every GPU of the host, and its processor), cpu, cuda (every GPU) or cuda:N. Jobs that ask for
    another one, for more memory than it has, or for other labels than `labels` are left to other workers.

    `shared` is the storage in which several hosts have datasets and the files of jobs; the artifact folder is this
    host's own then, with copies of datasets of at most `max_copies_bytes`. No other worker may have the `name` (None:
    that of the host, numbered); a worker that is started again under its name goes on with its jobs at once. `threads`
    0: all cores but one. A render job fails at a frame that costs more than `max_footprint_pixels`, see
    ultragray.rendering.limits. Finished jobs are removed after `retention_days`; a job fails whose process does not get
    on for
    `stall_timeout_s`, or that runs for `max_run_s` in all; 0: never. Threads of DBOS are left behind: end the process
    by os._exit. Raises StartupFailed.
    """
    try:
        check_labels(labels, "label")
    except InvalidArgument as error:
        raise StartupFailed(error.detail, field="label") from None
    devices = devices_of(device)
    with (
        contextlib.closing(OpenStore(artifact_folder)),
        claim_name(artifact_folder, name, host_of_its_own=shared is not None) as executor,
    ):
        jobs = JobDatabase(artifact_folder, database_url, shared)
        config = WorkerConfig(
            artifact_folder=artifact_folder.resolve(),
            executor=executor,
            shared=shared,
            max_copies_bytes=max_copies_bytes,
            threads=threads or max(1, (os.cpu_count() or 1) - 1),
            nice=nice,
            max_footprint_pixels=max_footprint_pixels,
            stall_timeout_s=stall_timeout_s,
            max_run_s=max_run_s,
        )
        locks = [DeviceLock(config.artifact_folder, one, executor) for one in devices]
        gate = Gate(jobs.folder, locks, tuple(sorted(labels.items())), lambda: unfinished.demands_waiting(jobs))
        supervisor = Supervisor(config, jobs, gate)

        def obey(wanted: Wanted) -> None:
            if gate.is_resting is not (wanted is not Wanted.WORK):
                _log.info(f"worker {executor} is to {wanted.value}")
            gate.is_resting = wanted is not Wanted.WORK
            supervisor.is_draining = wanted is Wanted.DRAIN

        heartbeat = Heartbeat(
            jobs,
            executor,
            job_at_hand=lambda: supervisor.job_at_hand,
            is_stuck=lambda: supervisor.is_stuck,
            device=device,
            offer=gate.offer,
            obey=obey,
        )
        unfinished.adopt_older(jobs)
        _launch(jobs.url, config, supervisor, gate)
        housekeeper = Housekeeper(jobs, config.artifact_folder, retention_days, shared)
        if retention_days:
            housekeeper.start()
        fields = {"worker": executor, "threads": config.threads, "offer": str(gate.offer)}
        _log.info(f"worker {executor} takes jobs", extra={"fields": fields})
        ready()
        while not stop.wait(alive_every_s):
            if not supervisor.is_stuck:
                tell_alive()
        housekeeper.stop()
        supervisor.stop(drain_timeout_s, hurry or threading.Event())
        heartbeat.stop()
        _log.info(f"worker {executor} stopped")


def _launch(url: str, config: WorkerConfig, supervisor: Supervisor, gate: Gate) -> None:
    def run(request: dict[str, Any]) -> dict[str, Any]:
        job_id = DBOS.workflow_id
        assert job_id is not None
        try:
            outcome = supervisor.supervise(job_id, request)
        except Interrupted:
            raise NotMine(job_id) from None  # any other error would be kept as the job's end
        if outcome.error is not None:
            raise PortableWorkflowError(outcome.reason or outcome.error, outcome.error, data=outcome.to_dict())
        return outcome.to_dict()

    dbos = DBOS(config=dbos_config(url, config.executor))
    for kind in (*KINDS, SHARE):
        # However often its worker dies, a job does not fail for it.
        DBOS.workflow(name=kind, max_recovery_attempts=None, serialization_type=WorkflowSerializationFormat.PORTABLE)(
            run
        )
    quiet_dbos()
    DBOS.listen_queues([database.QUEUE])
    DBOS.launch()
    leave_others_room(dbos, database.QUEUE)
    take_only_through(dbos, database.QUEUE, gate.opens, gate.close)
    DBOS.register_queue(database.QUEUE, worker_concurrency=1, polling_interval_sec=POLLING_INTERVAL_S)


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
            try:
                fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield candidate
            return
    raise StartupFailed(f"another worker is called {name!r}: give this one another name", field="name")


def _host_id(folder: Path) -> str:
    """The id of this host among those that share a storage, the same after a restart."""
    kept = LocalStorage(folder)
    kept.write(_HOST_ID_FILE, secrets.token_hex(3).encode(), if_absent=True)
    return kept.read(_HOST_ID_FILE).decode("ascii")
