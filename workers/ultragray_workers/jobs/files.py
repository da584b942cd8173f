"""The files of jobs as services read and remove them: objects of the storage, by what the row of the job names.

What a worker writes is in `worker.telling`; where an object lies is said by `jobs.progress.Files`. Free of torch.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ultragray_workers.jobs.progress import Files, Piece, StoredFile
from ultragray_workers.jobs.record import Row
from ultragray_workers.scene_names import SUFFIX
from ultragray_workers.storage.storage import Entry, NotThere, Storage

FOLDER, BATCH = "jobs", "batch"
# Of a run; `ultragray.learn.training`, which writes all but the last, imports torch.
JOURNAL_NAME, CHECKPOINT_NAME, CONFIG_NAME = "metrics.jsonl", "checkpoint.safetensors", "config.json"
BASELINES_NAME = "baselines.json"  # what classical methods reach, PSNR in dB by their names


@dataclass(frozen=True)
class Artifact:
    """A whole object of the storage, to download."""

    storage: Storage
    name: str
    stored: StoredFile

    def read(self, start: int, length: int) -> bytes:
        """At most `length` bytes from `start` on; none at the end. Raises StorageUnavailable, NotThere, OSError."""
        return self.storage.read(self.stored.key, start=start, length=length)


@dataclass(frozen=True)
class Log:
    """The log of a job, there or not yet, whose pieces the workers that had the job have written."""

    storage: Storage
    files: Callable[[], Files]  # of the job as they are now

    def size(self) -> int:
        return sum(piece.bytes for piece in self.files().log)

    def read(self, start: int, length: int) -> bytes:
        """At most `length` bytes from `start` on. Raises StorageUnavailable."""
        return _read_pieces(self.storage, self.files().log, start, length)


class JobFiles:
    """The files of all jobs. Every method blocks, and raises StorageUnavailable where a storage is away."""

    def __init__(self, storage: Storage, row: Callable[[str], Row | None], folder: Path) -> None:
        """`row`: that of a job; `folder`: of this host, for what must be a file for a while."""
        self.storage, self._row, self._folder = storage, row, folder

    def log(self, job_id: str) -> Log:
        return Log(self.storage, lambda: self._files(job_id))

    def artifacts(self, job_id: str) -> dict[str, Artifact]:
        """The files to download, by name; of a batch with its shards."""
        files = dict(self._files(job_id).artifacts)
        for entry in self.storage.entries_in(batch_prefix(job_id)):
            files[entry.key.rpartition("/")[2]] = _whole(entry)
        return {name: Artifact(self.storage, name, stored) for name, stored in files.items()}

    def artifact(self, job_id: str, name: str) -> Artifact | None:
        """One file to download, of the name that it is known to have; None where it has gone."""
        stored = self._files(job_id).artifacts.get(name)
        key = f"{batch_prefix(job_id)}/{name}" if stored is None else stored.key
        entry = self.storage.entry(key)
        return None if entry is None else Artifact(self.storage, name, stored or _whole(entry))

    def journal(self, job_id: str) -> str:
        """The journal of a training so far; its last line may be half written."""
        files = self._files(job_id)
        if (stored := files.artifacts.get(JOURNAL_NAME)) is None and files.journal:
            size = sum(piece.bytes for piece in files.journal)
            return _read_pieces(self.storage, files.journal, 0, size).decode("utf-8", "replace")
        stored = stored or files.run.get(JOURNAL_NAME)
        return "" if stored is None else self._text(stored)

    def baselines(self, job_id: str) -> str:
        """What classical methods reach, JSON; empty before that is known."""
        files = self._files(job_id)
        stored = files.artifacts.get(BASELINES_NAME) or files.run.get(BASELINES_NAME)
        return "" if stored is None else self._text(stored)

    @contextlib.contextmanager
    def checkpoint(self, job_id: str) -> Iterator[tuple[Path, str] | None]:
        """The newest checkpoint of a training on this host, and a word that tells it from the next; None without."""
        stored = self._files(job_id).run.get(CHECKPOINT_NAME)
        with self._fetched(None if stored is None else stored.key) as path:
            yield None if path is None or stored is None else (path, stored.sha256)

    @contextlib.contextmanager
    def kept_scene(self, job_id: str, scene: str) -> Iterator[Path | None]:
        """The scene as it was kept for a job, on this host; None where it was not."""
        with self._fetched(scene_key(job_id, scene)) as path:
            yield path

    def keep_scene(self, path: Path, scene: str, job_id: str) -> None:
        """Keeps a scene, as it is now, for a job that is submitted. Raises FileNotFoundError where it is gone."""
        self.storage.upload(path, scene_key(job_id, scene))

    def keep_carried(self, name: str, content: bytes, job_id: str) -> None:
        """Keeps the file that comes with a job that is submitted."""
        self.storage.write(carried_key(job_id, name), content)

    def keep_carried_again(self, name: str, before: str, job_id: str) -> None:
        """Keeps the file of a job for the one in its place, too."""
        with self._fetched(carried_key(before, name)) as path:
            if path is not None:
                self.storage.upload(path, carried_key(job_id, name))

    def remove(self, job_id: str) -> None:
        self.storage.delete_all(f"{FOLDER}/{job_id}")

    def _files(self, job_id: str) -> Files:
        row = self._row(job_id)
        return Files() if row is None else row.files

    def _text(self, stored: StoredFile) -> str:
        try:
            return self.storage.read(stored.key).decode("utf-8", "replace")
        except NotThere:  # the next checkpoint has taken its place
            return ""

    @contextlib.contextmanager
    def _fetched(self, key: str | None) -> Iterator[Path | None]:
        """An object as a file of this host during the body; None where there is no such object (any more)."""
        if key is None:
            yield None
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self._folder, prefix=".fetched-") as folder:
            path = Path(folder, key.rpartition("/")[2])
            try:
                self.storage.download(key, path)
            except NotThere:
                yield None
            else:
                yield path


def batch_prefix(job_id: str) -> str:
    return f"{FOLDER}/{job_id}/{BATCH}"


def scene_key(job_id: str, scene: str) -> str:
    return f"{FOLDER}/{job_id}/{scene}{SUFFIX}"


def carried_key(job_id: str, name: str) -> str:
    return f"{FOLDER}/{job_id}/{name}"


def _read_pieces(storage: Storage, pieces: Sequence[Piece], start: int, length: int) -> bytes:
    chunks, begin, end = [], 0, start + length
    for piece in pieces:
        first, last = max(start, begin), min(end, begin + piece.bytes)
        if first < last:
            with contextlib.suppress(NotThere):  # the job was deleted meanwhile
                chunks.append(storage.read(piece.key, start=first - begin, length=last - first))
        begin += piece.bytes
    return b"".join(chunks)


def _whole(entry: Entry) -> StoredFile:
    """An object that no row names; its version stands for its hash, which is not known."""
    return StoredFile(entry.key, entry.bytes, entry.version)
