"""Removal of old jobs, a few at a time: those that finished long ago, and folders of which the queue knows no job.

Any number of workers may do this at once. Scenes that jobs made stay, and so does everything that a waiting or running
job still needs.
"""

from __future__ import annotations

import logging
import re
import shutil
import threading
import time
from collections.abc import Iterator
from datetime import datetime, timezone
from itertools import islice
from pathlib import Path

from sqlalchemy.exc import SQLAlchemyError

from ultragray.errors import UltragrayError
from ultragray_workers.claims import DELETED_PREFIX, remove_whole
from ultragray_workers.datasets.shared_shelf import SharedShelf
from ultragray_workers.datasets.store import FOLDER as DATASETS
from ultragray_workers.errors import JobInUse, StorageUnavailable
from ultragray_workers.jobs.folder import FOLDER, JobFolder
from ultragray_workers.jobs.kinds import KINDS
from ultragray_workers.jobs.places import files_of_jobs
from ultragray_workers.jobs.queue import database, unfinished
from ultragray_workers.jobs.queue.database import JobDatabase
from ultragray_workers.jobs.removal import remove_job
from ultragray_workers.rounds import Rounds
from ultragray_workers.storage.storage import Storage

INTERVAL_S = 3600.0
STEP_PAUSE_S = 1.0
AT_ONCE = 20  # jobs of one step
DAY_S = 86_400.0
_FINISHED = (*database.SUCCEEDED, *database.FAILED, *database.CANCELLED)
_JOB_ID = re.compile(r"[0-9a-f]{24}(-[0-9a-f]{8})?")  # of a job, or a share of it

_log = logging.getLogger("ultragray.jobs")


class Housekeeper:
    """Removes jobs that finished more than `retention_days` ago, every hour."""

    def __init__(
        self, jobs: JobDatabase, artifact_folder: Path, retention_days: float, shared: Storage | None = None
    ) -> None:
        """`shared`: the storage in which several hosts have the files; None: they are in the artifact folder."""
        self._database, self._artifact_folder, self._shared = jobs, artifact_folder, shared
        self._files = files_of_jobs(artifact_folder, shared)
        self._retention_s = retention_days * DAY_S
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="housekeeper", daemon=True)

    def start(self) -> None:
        """Begins at once, in a thread of its own."""
        self._thread.start()

    def stop(self) -> None:
        """Ends after the removal at hand."""
        self._stop.set()

    def keep_house(self) -> int:
        """One round: how many jobs and folders were removed. Raises UltragrayError where the database is away."""
        removed = 0
        kept: set[str] = set()
        while not self._stop.is_set() and (old := self._finished_long_ago(kept | unfinished.sources(self._database))):
            for job_id in old:
                try:
                    remove_job(self._database, self._files, job_id)
                    removed += 1
                except (JobInUse, StorageUnavailable, OSError):
                    kept.add(job_id)
            self._stop.wait(STEP_PAUSE_S)
        strays = self._stray_folders()
        while not self._stop.is_set() and (some := list(islice(strays, AT_ONCE))):
            for folder in self._without_job(some):
                remove_whole(folder)
                removed += 1
            self._stop.wait(STEP_PAUSE_S)
        if self._shared is not None and not self._stop.is_set():
            removed += self._remove_stray_objects(self._shared)
        return removed

    def _remove_stray_objects(self, shared: Storage) -> int:
        """Removes what the storage holds of jobs that the queue does not know, and of uploads that were cut off."""
        newest: dict[str, float] = {}
        for entry in shared.entries(FOLDER):
            job_id = entry.key.split("/")[1]
            newest[job_id] = max(entry.modified, newest.get(job_id, 0.0))
        old = iter([one for one, at in newest.items() if time.time() - at > DAY_S and _JOB_ID.fullmatch(one)])
        removed = SharedShelf(shared, self._artifact_folder / DATASETS).remove_stray_files()
        while not self._stop.is_set() and (some := list(islice(old, AT_ONCE))):
            for job_id in set(some) - self._known(some):
                with self._files.removed(job_id):
                    removed += 1
            self._stop.wait(STEP_PAUSE_S)
        return removed

    def _finished_long_ago(self, kept: set[str]) -> list[str]:
        rows = self._database.client.list_workflows(
            name=list(KINDS),
            status=list(_FINISHED),
            completed_before=datetime.fromtimestamp(time.time() - self._retention_s, timezone.utc).isoformat(),
            limit=AT_ONCE + len(kept),
            load_input=False,
            load_output=False,
        )
        return [row.workflow_id for row in rows if row.workflow_id not in kept][:AT_ONCE]

    def _stray_folders(self) -> Iterator[Path]:
        """Folders that may be without a job: a day old, or of the retention's age where a process worked in them."""
        folder = self._artifact_folder / FOLDER
        for path in folder.iterdir() if folder.is_dir() else ():
            if path.name.startswith(DELETED_PREFIX):
                shutil.rmtree(path, ignore_errors=True)
            elif _JOB_ID.fullmatch(path.name):
                begun = JobFolder(self._artifact_folder, path.name).was_begun()
                if _age_s(path) > (max(DAY_S, self._retention_s) if begun else DAY_S):
                    yield path

    def _without_job(self, folders: list[Path]) -> list[Path]:
        known = self._known([path.name for path in folders])
        return [path for path in folders if path.name not in known]

    def _known(self, ids: list[str]) -> set[str]:
        """Those of the ids that are jobs of the queue."""
        rows = self._database.client.list_workflows(workflow_ids=ids, load_input=False, load_output=False)
        return {row.workflow_id for row in rows}

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
