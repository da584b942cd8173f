"""The files of jobs as services read and remove them: in an artifact folder, or in a storage that hosts share."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, TypeAlias

from ..claims import out_of_sight
from ..errors import StorageUnavailable
from ..scenes import SUFFIX
from ..storage.storage import NotThere, Storage
from .folder import JobFolder, Progress
from .removal import locked
from .requirements import keep_in_folder
from .shared.reading import SharedFile, SharedLog
from .shared.record import StoredFile, prefix_of, read_record, record_key

Artifact: TypeAlias = Path | SharedFile
Log: TypeAlias = Path | SharedLog
JOURNAL_NAME, CHECKPOINT_NAME = (
    "metrics.jsonl",
    "checkpoint.safetensors",
)  # of a run: `ultragray.training` imports torch


def size_of_log(log: Log) -> int:
    """The bytes of a log; 0 where there is none yet. Raises StorageUnavailable."""
    if isinstance(log, SharedLog):
        return log.size()
    try:
        return log.stat().st_size
    except FileNotFoundError:
        return 0


def read_log(log: Log, start: int, length: int) -> bytes:
    """At most `length` bytes of a log from `start` on. Raises StorageUnavailable."""
    if isinstance(log, SharedLog):
        return log.read(start, length)
    try:
        with log.open("rb") as file:
            file.seek(start)
            return file.read(length)
    except FileNotFoundError:
        return b""


class JobFiles(Protocol):
    """Where the files of jobs are. Every method blocks, and raises StorageUnavailable where a storage is away."""

    def progress(self, job_id: str) -> Progress:
        """How far the job is, as far as it is known now. Raises nothing."""

    def log(self, job_id: str) -> Log:
        """The log of the job, there or not yet."""

    def artifacts(self, job_id: str) -> dict[str, Artifact]:
        """The files to download, by name."""

    def journal(self, job_id: str) -> str | None:
        """The lines of the training so far; None before there are any. The last one may be half written."""

    def checkpoint(self, job_id: str) -> contextlib.AbstractContextManager[tuple[Path, str] | None]:
        """The newest checkpoint of the training on this host, and a word that tells it from the next; None without."""

    def kept_scene(self, job_id: str, scene: str) -> contextlib.AbstractContextManager[Path | None]:
        """The scene as it was kept for the job, on this host; None where it was not."""

    def keep_scene(self, path: Path, scene: str, job_id: str) -> None:
        """Keeps a scene, as it is now, for a job that is submitted. Raises FileNotFoundError where it is gone."""

    def removed(self, job_id: str) -> contextlib.AbstractContextManager[None]:
        """Removes the files of a finished job; nobody finds them during the body.

        Raises JobInUse while a process of the job still ends. Where the body raises, a folder is as before; of a
        storage the files have gone.
        """


class FolderFiles:
    """The folders of the jobs in an artifact folder."""

    def __init__(self, artifact_folder: Path) -> None:
        self._artifact_folder = artifact_folder

    def progress(self, job_id: str) -> Progress:
        """As `JobFiles`."""
        return self._folder(job_id).progress()

    def log(self, job_id: str) -> Log:
        """As `JobFiles`."""
        return self._folder(job_id).log

    def artifacts(self, job_id: str) -> dict[str, Artifact]:
        """As `JobFiles`."""
        with contextlib.suppress(FileNotFoundError):
            return {path.name: path for path in self._folder(job_id).artifacts.iterdir()}
        return {}

    def journal(self, job_id: str) -> str | None:
        """As `JobFiles`."""
        folder = self._folder(job_id)
        for place in (folder.artifacts, folder.run):
            with contextlib.suppress(FileNotFoundError):
                return (place / JOURNAL_NAME).read_text(encoding="utf-8")
        return None

    @contextlib.contextmanager
    def checkpoint(self, job_id: str) -> Iterator[tuple[Path, str] | None]:
        """As `JobFiles`."""
        path = self._folder(job_id).run / CHECKPOINT_NAME
        try:
            version = str(path.stat().st_mtime_ns)
        except FileNotFoundError:
            yield None
        else:
            yield path, version

    @contextlib.contextmanager
    def kept_scene(self, job_id: str, scene: str) -> Iterator[Path | None]:
        """As `JobFiles`."""
        kept = self._folder(job_id).path / f"{scene}{SUFFIX}"
        yield kept if kept.is_file() else None

    def keep_scene(self, path: Path, scene: str, job_id: str) -> None:
        """As `JobFiles`."""
        keep_in_folder(path, scene, self._folder(job_id))

    @contextlib.contextmanager
    def removed(self, job_id: str) -> Iterator[None]:
        """As `JobFiles`."""
        folder = self._folder(job_id)
        with contextlib.ExitStack() as stack:
            if folder.path.is_dir():
                stack.enter_context(locked(folder))
            stack.enter_context(out_of_sight(folder.path))
            yield

    def _folder(self, job_id: str) -> JobFolder:
        return JobFolder(self._artifact_folder, job_id)


class SharedFiles:
    """The objects of the jobs in a storage, with what must be a file for a while in a folder of this host."""

    def __init__(self, storage: Storage, folder: Path) -> None:
        self._storage, self._folder = storage, folder

    def progress(self, job_id: str) -> Progress:
        """As `JobFiles`."""
        with contextlib.suppress(StorageUnavailable):
            if (record := read_record(self._storage, job_id)) is not None:
                return record.progress
        return Progress()

    def log(self, job_id: str) -> Log:
        """As `JobFiles`."""
        return SharedLog(self._storage, job_id)

    def artifacts(self, job_id: str) -> dict[str, Artifact]:
        """As `JobFiles`."""
        record = read_record(self._storage, job_id)
        if record is None:
            return {}
        return {name: SharedFile(self._storage, name, stored) for name, stored in record.artifacts.items()}

    def journal(self, job_id: str) -> str | None:
        """As `JobFiles`: as long as the training runs, as its last checkpoint has it."""
        record = read_record(self._storage, job_id)
        for files in () if record is None else (record.artifacts, record.run):
            if (stored := files.get(JOURNAL_NAME)) is not None:
                with contextlib.suppress(NotThere):  # the next checkpoint has taken its place
                    return self._storage.read(stored.key).decode("utf-8", "replace")
        return None

    @contextlib.contextmanager
    def checkpoint(self, job_id: str) -> Iterator[tuple[Path, str] | None]:
        """As `JobFiles`."""
        record = read_record(self._storage, job_id)
        stored = None if record is None else record.run.get(CHECKPOINT_NAME)
        with self._fetched(stored) as path:
            yield None if path is None or stored is None else (path, stored.sha256)

    @contextlib.contextmanager
    def kept_scene(self, job_id: str, scene: str) -> Iterator[Path | None]:
        """As `JobFiles`."""
        entry = self._storage.entry(f"{prefix_of(job_id)}/{scene}{SUFFIX}")
        with self._fetched(None if entry is None else StoredFile(entry.key, entry.bytes, "")) as path:
            yield path

    def keep_scene(self, path: Path, scene: str, job_id: str) -> None:
        """As `JobFiles`."""
        self._storage.upload(path, f"{prefix_of(job_id)}/{scene}{SUFFIX}")

    @contextlib.contextmanager
    def removed(self, job_id: str) -> Iterator[None]:
        """As `JobFiles`. A worker that still ends the job finds its record gone, and writes no more."""
        self._storage.delete(record_key(job_id))
        for entry in list(self._storage.entries(prefix_of(job_id))):
            self._storage.delete(entry.key)
        yield

    @contextlib.contextmanager
    def _fetched(self, stored: StoredFile | None) -> Iterator[Path | None]:
        """A copy of an object on this host during the body; None where there is no such object (any more)."""
        if stored is None:
            yield None
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self._folder, prefix=".fetched-") as folder:
            path = Path(folder, Path(stored.key).name)
            try:
                self._storage.download(stored.key, path)
            except NotThere:
                yield None
            else:
                yield path


def files_of_jobs(artifact_folder: Path, shared: Storage | None) -> JobFiles:
    """The files of the jobs of a storage that hosts share; None: of the artifact folder."""
    return FolderFiles(artifact_folder) if shared is None else SharedFiles(shared, artifact_folder)
