"""Removal of old jobs, a few at a time: those that finished long ago, and files of which the queue knows no job.

Any number of workers may do this at once. Scenes that jobs made stay, and so does everything that a waiting or running
job still needs. Free of torch.
"""

from __future__ import annotations

import logging
import re
import threading
import time
from collections.abc import Callable, Iterable
from itertools import islice
from pathlib import Path

from sqlalchemy.exc import SQLAlchemyError

from ultragray.errors import UltragrayError
from ultragray_workers.claims import remove_whole
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import StorageUnavailable
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.files import FOLDER, JobFiles
from ultragray_workers.jobs.folder import WORK
from ultragray_workers.rounds import Rounds
from ultragray_workers.storage.storage import Storage

INTERVAL_S = 3600.0
STEP_PAUSE_S = 1.0
AT_ONCE = 20  # jobs of one step
DAY_S = 86_400.0
_JOB_ID = re.compile(r"[0-9a-f]{24}(-[0-9a-f]{8})?")  # of a job, or a share of it

_log = logging.getLogger("ultragray.jobs")


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
            finished_before_s = time.time() - self._retention_s
            if not (old := queue.finished_before(self._engine, finished_before_s, kept, AT_ONCE)):
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
        folders = {path.name: path for path in (self._artifact_folder / WORK).glob("*") if _age_s(path) > DAY_S}
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
        removed, left = 0, iter([job_id for job_id in ids if _JOB_ID.fullmatch(job_id)])
        while not self._stop.is_set() and (some := list(islice(left, AT_ONCE))):
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


def _age_s(path: Path) -> float:
    try:
        return time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return 0.0
