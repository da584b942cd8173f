"""The working folder of an attempt at a job on the host of its worker, in which the worker and the job's process meet.

job.json        what is asked for: written by the worker before its process starts
lock            held by the one process that works in the folder, whose number it says
NAME.ugr        the scene that the job needs
run/            the trainer's folder: checkpoint, journal, configuration; of a comparison one for each method within
progress.json   how far it is
log.txt         what the process said
reserve         room on the disk, given back when the process has ended
artifacts/      what can be downloaded; appears whole
outcome.json    how it ended: the last thing that the process writes
scratch.partial files of a step that are not kept: see `JobFolder.scratch`

The worker puts into the storage what others are to have (`worker.telling`), and removes the folder with its work.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from ultragray.files import remove_stale_temporaries, sync, write_whole
from ultragray_workers.jobs.progress import Outcome, Progress, from_json, to_json
from ultragray_workers.storage.cache import DEFAULT_MAX_BYTES

WORK = "work"  # of the artifact folder
_T = TypeVar("_T")


@dataclass(frozen=True)
class Request:
    """The instructions of a worker to the process of a job."""

    specification: dict[str, Any]
    submitted: int  # number of the job: tells it from an earlier one of its id, whose database is lost
    batch: str | None  # of a share
    retry_of: str | None
    device: str  # cpu, cuda or cuda:N
    threads: int
    nice: int
    artifact_folder: str
    storage: str  # location of the datasets and of the files of jobs
    max_footprint_pixels: int | None = None  # of a frame, see ultragray.rendering.limits; None: no limit
    max_copies_bytes: int = DEFAULT_MAX_BYTES  # of copies of datasets on this host
    longest_share_s: float = float("inf")  # then a share of a batch ends, where other jobs wait


class JobFolder:
    """The paths of one attempt at a job, and its small files."""

    def __init__(self, artifact_folder: Path, job_id: str, attempt: int = 1) -> None:
        self.artifact_folder, self.job_id = Path(artifact_folder), job_id
        self.path = self.artifact_folder / WORK / f"{job_id}.{attempt}"
        self.lock = self.path / "lock"
        self.run = self.path / "run"
        self.log = self.path / "log.txt"
        self.reserve = self.path / "reserve"
        self.artifacts = self.path / "artifacts"
        self._partial = self.path / "artifacts.partial"
        self._scratch = self.path / "scratch.partial"
        self._request = self.path / "job.json"
        self._progress = self.path / "progress.json"
        self._outcome = self.path / "outcome.json"

    def request(self) -> Request | None:
        return _read(Request, self._request)

    @property
    def attempt(self) -> int:
        return int(self.path.name.rpartition(".")[2])

    def others(self) -> list[JobFolder]:
        paths = self.path.parent.glob(f"{self.job_id}.*")
        attempts = [int(path.suffix[1:]) for path in paths if path.suffix[1:].isdigit() and path != self.path]
        return [JobFolder(self.artifact_folder, self.job_id, attempt) for attempt in attempts]

    def make(self) -> None:
        shutil.rmtree(self.path, ignore_errors=True)
        self.path.mkdir(parents=True)

    def remove(self) -> None:
        shutil.rmtree(self.path, ignore_errors=True)

    def write_request(self, request: Request) -> None:
        _write(self._request, request)

    def progress(self) -> Progress:
        return _read(Progress, self._progress) or Progress()

    def write_progress(self, progress: Progress) -> None:
        _write(self._progress, progress)

    def outcome(self) -> Outcome | None:
        try:
            return from_json(Outcome, self._outcome.read_bytes())
        except FileNotFoundError:
            return None

    def write_outcome(self, outcome: Outcome) -> None:
        _write(self._outcome, outcome)

    @contextlib.contextmanager
    def new_artifacts(self) -> Iterator[Path]:
        """An empty folder for the artifacts, which becomes `artifacts` at the end; nothing where the body raises."""
        shutil.rmtree(self._partial, ignore_errors=True)
        shutil.rmtree(self.artifacts, ignore_errors=True)  # of a process that died before it wrote its outcome
        self._partial.mkdir()
        try:
            yield self._partial
            for path in self._partial.iterdir():
                sync(path)
            sync(self._partial)
            self._partial.rename(self.artifacts)
            sync(self.path)
        finally:
            shutil.rmtree(self._partial, ignore_errors=True)

    @contextlib.contextmanager
    def scratch(self) -> Iterator[Path]:
        """An empty folder for what is not kept, removed after the body. One at a time."""
        shutil.rmtree(self._scratch, ignore_errors=True)
        self._scratch.mkdir()
        try:
            yield self._scratch
        finally:
            shutil.rmtree(self._scratch, ignore_errors=True)

    def remove_leftovers(self) -> None:
        """Removes the half written files of killed processes; no process may be at the job meanwhile."""
        shutil.rmtree(self._partial, ignore_errors=True)
        shutil.rmtree(self._scratch, ignore_errors=True)
        with contextlib.suppress(OSError):
            self.reserve.unlink(missing_ok=True)
            for path in (self._request, self._progress, self._outcome):
                remove_stale_temporaries(path)

    def artifact_names(self) -> tuple[str, ...]:
        return tuple(sorted(path.name for path in self.artifacts.iterdir()))


def _read(kind: type[_T], path: Path) -> _T | None:
    try:
        return from_json(kind, path.read_bytes())
    except (OSError, ValueError):
        return None


def _write(path: Path, document: object) -> None:
    write_whole(path, to_json(document) + "\n")
