"""The files of jobs in a storage that several hosts share. Free of torch."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from ultragray_workers.errors import StorageUnavailable
from ultragray_workers.jobs.files import CHECKPOINT_NAME, Artifact, Log
from ultragray_workers.jobs.folder import Progress
from ultragray_workers.jobs.shared.reading import SharedFile, SharedLog
from ultragray_workers.jobs.shared.record import StoredFile, batch_prefix_of, prefix_of, read_record, record_key
from ultragray_workers.scenes import SUFFIX
from ultragray_workers.storage.storage import Entry, NotThere, Storage


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
        files = {} if record is None else dict(record.artifacts)
        for entry in self._storage.entries_in(batch_prefix_of(job_id)):
            files[entry.key.rpartition("/")[2]] = _whole(entry)
        return {name: SharedFile(self._storage, name, stored) for name, stored in files.items()}

    def artifact(self, job_id: str, name: str) -> Artifact | None:
        """As `JobFiles`."""
        record = read_record(self._storage, job_id)
        stored = None if record is None else record.artifacts.get(name)
        if stored is None and (entry := self._storage.entry(f"{batch_prefix_of(job_id)}/{name}")) is not None:
            stored = _whole(entry)
        return None if stored is None else SharedFile(self._storage, name, stored)

    def text_of_run(self, job_id: str, name: str) -> str | None:
        """As `JobFiles`: as long as the training runs, as its last checkpoint has it."""
        record = read_record(self._storage, job_id)
        for files in () if record is None else (record.artifacts, record.run):
            if (stored := files.get(name)) is not None:
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
        with self._fetched(None if entry is None else _whole(entry)) as path:
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


def _whole(entry: Entry) -> StoredFile:
    """An object that no record names; its hash is not known."""
    return StoredFile(entry.key, entry.bytes, "")
