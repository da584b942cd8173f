"""The making of a backup beside a service and workers that go on, its verification, and the removal of old ones.

The order makes it consistent. Files are copied first, as they are; then the database at one moment; then once more the
files that changed in between, of which there are few. Whatever the database says of a job is in its folder before the
database says it, so that the later files have it. What was taken away in between, jobs that were deleted or cancelled,
the manifest says, and a restore takes it away too. Jobs that came after the moment are left out.
"""

from __future__ import annotations

import contextlib
import fcntl
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import ultragray
from ultragray_workers.backup import manifest as manifests
from ultragray_workers.backup.contents import DATA, Folders, Objects, StoredFile, files_of, job_id_of
from ultragray_workers.backup.database_copy import Database
from ultragray_workers.backup.manifest import FileEntry, Manifest
from ultragray_workers.errors import BackupInvalid, RestoreRefused
from ultragray_workers.jobs.progress import JobState

_SETTLE_S = 5.0  # a job that is just being deleted has lost its folder, and soon its row
_SETTLE_POLL_S = 0.1
_Known = dict[tuple[str, str], FileEntry]


@dataclass(frozen=True)
class Report:
    """What a backup has copied."""

    manifest: Manifest
    new_files: int  # contents that no earlier backup in the folder had
    new_bytes: int
    removed_backups: int = 0
    removed_bytes: int = 0


def back_up(folders: Folders, database_url: str | None, backup_folder: Path, *, keep: int | None = None) -> Report:
    """Adds a backup to a folder, and removes all but the newest `keep`; None: it keeps all.

    Raises RestoreRefused for a data folder that is not there, or that holds the backup folder, BackupInvalid,
    StartupFailed and OSError.
    """
    _check_place(backup_folder, folders)
    backup_folder.mkdir(mode=0o700, parents=True, exist_ok=True)  # all that anybody trained, and the hashes of keys
    with alone_in(backup_folder):
        objects = Objects(backup_folder)
        objects.remove_leftovers()
        backup = _Backup(folders, Database(folders.artifacts, database_url), objects, _known(backup_folder))
        manifest = backup.make(backup_folder)
        manifests.write(backup_folder, manifest)
        old = [] if keep is None else manifests.names(backup_folder)[:-keep]
        for name in old:
            manifests.remove(backup_folder, name)
        removed_bytes = _remove_unused(backup_folder, objects) if old else 0
    return Report(manifest, backup.new_files, backup.new_bytes, len(old), removed_bytes)


def verify(backup_folder: Path) -> Iterator[tuple[Manifest, list[str]]]:
    """Every backup of a folder, and the hashes of its contents that are missing or damaged; each is read once."""
    objects = Objects(backup_folder)
    whole: dict[str, bool] = {}
    for name in manifests.names(backup_folder):
        manifest = manifests.read(backup_folder, name)
        for sha256 in manifest.objects():
            if sha256 not in whole:
                whole[sha256] = objects.is_whole(sha256)
        yield manifest, [sha256 for sha256 in manifest.objects() if not whole[sha256]]


@contextlib.contextmanager
def alone_in(backup_folder: Path) -> Iterator[None]:
    """Raises RestoreRefused where another process works in the backup folder."""
    with (backup_folder / "lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RestoreRefused(f"another backup or restore is at work in {backup_folder}: wait for its end") from None
        yield


class _Backup:
    def __init__(self, folders: Folders, database: Database, objects: Objects, known: _Known) -> None:
        self._folders, self._database, self._objects = folders, database, objects
        self._known = known
        self.new_files = self.new_bytes = 0

    def make(self, backup_folder: Path) -> Manifest:
        name = _now()
        self._copy_files()
        with tempfile.TemporaryDirectory(dir=backup_folder, prefix=".work-") as work:
            snapshot = self._database.snapshot(self._objects, Path(work))
        states = {} if snapshot is None else dict(snapshot.states)
        entries = self._copy_files()
        now, entries = self._settled(states, entries)
        deleted = states.keys() - now.keys()
        ids = states.keys() - deleted
        files = tuple(entry for entry in entries if (job := job_id_of(entry.root, entry.path)) is None or job in ids)
        waiting = {job for job in ids if not states[job].is_final}
        return Manifest(
            name=name,
            release=ultragray.__version__,
            files=files,
            database=None if snapshot is None else snapshot.entry,
            deleted_jobs=tuple(sorted(deleted)),
            cancelled_jobs=tuple(sorted(job for job in waiting if now[job] is JobState.CANCELLED)),
            counts=_counts(files, ids, waiting),
        )

    def _settled(
        self, states: Mapping[str, JobState], entries: list[FileEntry]
    ) -> tuple[Mapping[str, JobState], list[FileEntry]]:
        """The jobs as they are after the files were copied, and the files, when no job is half deleted."""
        end = time.monotonic() + _SETTLE_S
        while True:
            now = self._database.states()
            ids = {job_id_of(entry.root, entry.path) for entry in entries}
            lost = [job for job in now if states.get(job) is JobState.SUCCEEDED and job not in ids]
            if not lost or time.monotonic() > end:  # its folder was lost otherwise, which a backup does not mend
                return now, entries
            time.sleep(_SETTLE_POLL_S)
            entries = self._copy_files()

    def _copy_files(self) -> list[FileEntry]:
        return [entry for file in files_of(self._folders, self._database.sqlite) if (entry := self._copy(file))]

    def _copy(self, file: StoredFile) -> FileEntry | None:
        """None for a file that went meanwhile."""
        place = (file.root, str(file.path))
        try:
            version = file.version()
            known = self._known.get(place)
            if known is not None and known.version == version.tag and self._objects.has(known.sha256):
                return known
            stored = self._objects.add(file.source, grows=file.grows)
        except FileNotFoundError:
            return None
        self.new_files += stored.is_new
        self.new_bytes += stored.version.size if stored.is_new else 0
        entry = FileEntry(*place, stored.sha256, stored.version.size, stored.version.mtime_ns, stored.version.tag)
        self._known[place] = entry
        return entry


def _check_place(backup_folder: Path, folders: Folders) -> None:
    if not folders.data.is_dir():
        raise RestoreRefused(f"data_folder must be an existing folder, got {str(folders.data)!r}", field="data_folder")
    place = backup_folder.resolve()
    for folder in (folders.data, folders.artifacts):
        if place.is_relative_to(folder.resolve()):
            raise RestoreRefused(f"{backup_folder} lies within {folder}, which it would save: name another folder")


def _known(backup_folder: Path) -> _Known:
    """The files of the newest backup that can be read: those that have not changed need not be."""
    for name in reversed(manifests.names(backup_folder)):
        with contextlib.suppress(BackupInvalid):
            return {(entry.root, entry.path): entry for entry in manifests.read(backup_folder, name).files}
    return {}


def _remove_unused(backup_folder: Path, objects: Objects) -> int:
    """Raises BackupInvalid where a list of the folder cannot be read: nothing is removed then."""
    needed = {one for name in manifests.names(backup_folder) for one in manifests.read(backup_folder, name).objects()}
    _, removed_bytes = objects.remove_all_but(needed)
    return removed_bytes


def _counts(files: Iterable[FileEntry], jobs: Iterable[str], waiting: Iterable[str]) -> dict[str, int]:
    kinds = Counter("scenes" if entry.root == DATA else entry.path.partition("/")[0] for entry in files)
    datasets = {entry.path for entry in files if entry.root != DATA and entry.path.startswith("datasets/")}
    return {
        "scenes": kinds["scenes"],
        "datasets": len(datasets),
        "jobs": len(list(jobs)),
        "unfinished jobs": len(list(waiting)),
    }


def _now() -> str:
    now = datetime.now(timezone.utc)
    return f"{now:%Y%m%dT%H%M%S}.{now.microsecond // 1000:03}Z"
