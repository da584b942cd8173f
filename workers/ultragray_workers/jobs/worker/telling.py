"""The job of a worker as others see it: begun from what there is of it, and told to them as it goes on.

The worker and the job's process work in a folder of their host (`jobs.folder`). A thread puts the log, the journal and
each new checkpoint into the storage, and then names them in the job's row: a checkpoint counts whole or not at all.
While the storage or the database is away the work goes on, and what was missed is told when it is back. Free of torch.
"""

from __future__ import annotations

import contextlib
import logging
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, wait
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from ultragray.errors import TrainingStateInvalid
from ultragray.files import TEMPORARY_SUFFIX, file_sha256
from ultragray_workers.errors import ArtifactFolderUnavailable, DatabaseUnavailable, StorageFull, StorageUnavailable
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.files import (
    BASELINES_NAME,
    CONFIG_NAME,
    FOLDER,
    JOURNAL_NAME,
    batch_prefix,
    carried_key,
    scene_key,
)
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.kinds.base import carried_name, is_in_shards, value_in
from ultragray_workers.jobs.progress import Files, Outcome, Piece, StoredFile
from ultragray_workers.jobs.record import Row
from ultragray_workers.jobs.worker.process import end_process_of_another_worker
from ultragray_workers.scene_names import SUFFIX
from ultragray_workers.storage.storage import NotThere, Storage

TELL_INTERVAL_S = 0.5
LAST_WAIT_S = 10.0  # for what a job leaves that goes on elsewhere
PIECE_BYTES = 256 * 1024  # of a file that grows: the last piece is written again when it has grown
MOST_BYTES = 4 * PIECE_BYTES  # of such a file, told at once
_RETRY_S, _LONGEST_RETRY_S = 0.5, 10.0
_LOOK_S = 0.25
# Beside a checkpoint: they say nothing without it, and a journal grows all the time.
_BESIDE = (JOURNAL_NAME, CONFIG_NAME, BASELINES_NAME)
_PICTURE = ".png"  # of a validation: likewise
_AWAY = (StorageUnavailable, ArtifactFolderUnavailable, DatabaseUnavailable, StorageFull, OSError)

_log = logging.getLogger("ultragray.jobs")
_T = TypeVar("_T")
_Version = Mapping[str, int]  # the time of each file of a run that is replaced whole, by its path within the run


class Superseded(Exception):
    """Another worker goes on with the job: this one must not write anything of it any more."""


class Telling:
    """What others know of the job at hand."""

    def __init__(
        self, jobs: JobDatabase, storage: Storage, folder: JobFolder, row: Row, watch: Callable[[], None]
    ) -> None:
        """`watch`: called while something takes long; what it raises ends that."""
        self._engine, self._storage, self._folder, self._row, self._watch = jobs.engine, storage, folder, row, watch
        self._require_storage = jobs.identity.check  # before it is written to: a share may have gone
        self._prefix = f"{FOLDER}/{row.id}/{row.number}-{row.attempt}"
        self._files = row.files
        self._progress = row.progress
        self._log = _GrowingFile(self._write, folder.log, f"{self._prefix}/log")
        self._journal = _GrowingFile(self._write, folder.run / JOURNAL_NAME, f"{self._prefix}/journal")
        self._telling = threading.Lock()
        self._ended = threading.Event()
        self._is_begun = self._is_away = False
        self._run_version: _Version = {}  # of the checkpoint that was told last
        self._run_files: dict[str, StoredFile] = {}  # of that version, as far as this attempt has uploaded them
        self._runs = 0
        self._older_run: Mapping[str, StoredFile] = {}  # kept beside the newest, for a backup that is being made
        self._uploading: Future[dict[str, StoredFile] | None] | None = None

    def take_over(self) -> None:
        """Makes the job's folder, with what there is of the job; waits for a storage that is away. Raises OSError.

        What is there may also be how the job ended: its process, or a worker that was serving its scene, got so far.
        """
        self.patiently(self._take_over)
        self._is_begun = True

    @contextlib.contextmanager
    def telling(self) -> Iterator[None]:
        """Tells during the body what the job's process does."""
        threading.Thread(target=self._tell_now_and_then, name="telling", daemon=True).start()
        try:
            yield
        except BaseException:
            self.tell_last()
            raise
        finally:
            self._ended.set()

    def tell_last(self) -> None:
        """Tells what there is of a job that goes on elsewhere, or was cancelled, unless that takes long."""
        if self._ended.is_set() or not self._is_begun:
            return
        self._ended.set()
        last = _in_thread(lambda: self._tell(is_last=True))
        wait([last], LAST_WAIT_S)
        if not last.done() or last.exception() is not None:
            _log.warning(f"the end of the work at the job {self._row.id} here could not be told to others")

    def end(self, outcome: Outcome) -> Files:
        """Puts all that the job made into the storage, for which it waits; what its row is to name."""
        self._ended.set()
        return self.patiently(lambda: self._end(outcome))

    def remove_others(self) -> None:
        """Removes what counts no more of a job whose end is told: of earlier attempts and checkpoints."""
        keys, top = self._files.keys(), f"{FOLDER}/{self._row.id}"
        with contextlib.suppress(StorageUnavailable, OSError):
            for entry in list(self._storage.entries(top)):
                is_of_attempt = "/" in entry.key.removeprefix(f"{top}/")
                is_shard = entry.key.startswith(f"{batch_prefix(self._row.id)}/")
                if is_of_attempt and not is_shard and entry.key not in keys:
                    self._storage.delete(entry.key)
            self._storage.delete_half_written(top)

    def forget(self) -> None:
        self._ended.set()
        self._folder.remove()

    def patiently(self, work: Callable[[], _T]) -> _T:
        """What the work gives, in a thread, tried again while a storage is away. Raises what `watch` raises."""
        pause_s = _RETRY_S
        while True:
            future = _in_thread(work)
            while not future.done():
                self._watch()
                wait([future], _LOOK_S)
            try:
                result = future.result()
            except StorageUnavailable as error:
                self._note_away(error)
            else:
                self._note_back()
                return result
            end_s = time.monotonic() + pause_s
            while time.monotonic() < end_s:
                self._watch()
                time.sleep(_LOOK_S)
            pause_s = min(2.0 * pause_s, _LONGEST_RETRY_S)

    def _take_over(self) -> None:
        folder, row = self._folder, self._row
        if self._go_on_in_folder():
            return
        folder.make()
        if (scene := value_in(row.summary, "needs_scene")) is not None:
            with contextlib.suppress(NotThere):  # then the process says so
                self._storage.download(scene_key(row.batch or row.id, scene), folder.path / f"{scene}{SUFFIX}")
        if (name := carried_name(row.summary)) is not None:
            with contextlib.suppress(NotThere):
                self._storage.download(carried_key(row.id, name), folder.path / name)
        if row.progress is not None:
            folder.write_progress(row.progress)
        if row.published and row.outcome is not None:
            self._fetch(row.files.artifacts, folder.artifacts)
            folder.write_outcome(row.outcome)
        elif row.files.run:
            self._fetch(row.files.run, folder.run)
        elif row.retry_of is not None:
            before = queue.row_of(self._engine, row.retry_of)
            # One that could not be resumed from is no beginning.
            if before and not (before.outcome and before.outcome.error == TrainingStateInvalid.reason):
                self._fetch(before.files.run, folder.run)
        self._run_version = _version_of(folder.run)

    def _go_on_in_folder(self) -> bool:
        """Whether the folder is the one of the attempt before, of a worker of this host that died.

        Nobody has gone further than that folder says. Those of other attempts go, and processes that are left in them.
        """
        is_found = False
        for other in self._folder.others():
            end_process_of_another_worker(other)
            request = other.request()
            if request is not None and request.submitted == self._row.number and other.attempt == self._row.attempt - 1:
                self._folder.remove()
                other.path.rename(self._folder.path)
                self._folder.remove_leftovers()
                self._keep_untold_log()
                is_found = True
            else:
                other.remove()
        return is_found

    def _keep_untold_log(self) -> None:
        """Leaves in the log what the attempt before has not told: it counts as the beginning of this one's."""
        prefix = f"{FOLDER}/{self._row.id}/{self._row.number}-{self._row.attempt - 1}/"
        offset = sum(piece.bytes for piece in self._files.log if piece.key.startswith(prefix))
        with contextlib.suppress(FileNotFoundError):
            rest = self._folder.log.read_bytes()[offset:]
            self._folder.log.write_bytes(rest)

    def _fetch(self, files: Mapping[str, StoredFile], target: Path) -> None:
        """Copies files into a new folder, all of them or, where one is gone or damaged, none."""
        partial = target.with_name(f"{target.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        for name, stored in files.items():
            path = partial / name
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                if path.name == JOURNAL_NAME:  # which grows: a download may be a link
                    path.write_bytes(self._storage.read(stored.key))
                else:
                    self._storage.download(stored.key, path)
            except NotThere:
                _log.warning(f"{stored.key} is not there any more: the job {self._row.id} does without")
                break
            if file_sha256(path) != stored.sha256:
                _log.warning(f"{stored.key} is damaged: the job {self._row.id} does without")
                break
        else:
            if files:
                partial.rename(target)
        shutil.rmtree(partial, ignore_errors=True)

    def _tell_now_and_then(self) -> None:
        pause_s = TELL_INTERVAL_S
        while not self._ended.wait(pause_s):
            try:
                self._tell(is_last=False)
            except _AWAY as error:
                self._note_away(error)
                pause_s = min(2.0 * pause_s, _LONGEST_RETRY_S)
            except Superseded:  # the queue will say so, too
                return
            else:
                self._note_back()
                pause_s = TELL_INTERVAL_S

    def _tell(self, *, is_last: bool) -> None:
        with self._telling:
            progress, before = self._folder.progress(), self._files
            run = self._new_run(is_last=is_last)
            files = replace(
                before,
                log=self._log.pieces(before.log, everything=is_last),
                journal=self._journal.pieces((), everything=is_last),
                run=before.run if run is None else run,
            )
            if progress == self._progress and files == before:
                return
            if not queue.tell(self._engine, self._row, progress, files):
                raise Superseded
            self._files, self._progress = files, progress
            if run is not None:
                keys = {one.key for one in (*run.values(), *before.run.values())}
                for key in {one.key for one in self._older_run.values()} - keys:
                    self._storage.delete(key)
                self._older_run = before.run

    def _new_run(self, *, is_last: bool) -> dict[str, StoredFile] | None:
        """The files of a new checkpoint that are there whole; None: there is none since the last one."""
        uploaded: dict[str, StoredFile] | None = None
        if self._uploading is not None and (is_last or self._uploading.done()):
            uploading, self._uploading = self._uploading, None
            uploaded = uploading.result()
        version = _version_of(self._folder.run)
        if self._uploading is None and version and version != self._run_version:
            if is_last:
                return self._upload_run(version) or uploaded
            self._uploading = _in_thread(lambda: self._upload_run(version))
        return uploaded

    def _upload_run(self, version: _Version) -> dict[str, StoredFile] | None:
        """Uploads what is new of the checkpoint; None where it has changed already: then the next one is told."""
        self._runs += 1
        number, copies = self._runs, self._folder.path / f"told-{self._runs}"
        shutil.rmtree(copies, ignore_errors=True)
        try:
            if not copy_run(self._folder.run, version, copies):
                return None
            stored = {}
            for path in sorted(_run_files(copies)):
                name = path.relative_to(copies).as_posix()
                is_same = name in self._run_files and version.get(name, 0) == self._run_version.get(name)
                stored[name] = self._run_files[name] if is_same else self._upload(path, f"run-{number}/{name}")
        finally:
            shutil.rmtree(copies, ignore_errors=True)
        self._run_version, self._run_files = version, stored
        return stored

    def _upload(self, path: Path, name: str, sha256: str | None = None) -> StoredFile:
        stored = StoredFile(f"{self._prefix}/{name}", path.stat().st_size, sha256 or file_sha256(path))
        self._require_storage()
        self._storage.upload(path, stored.key)
        return stored

    def _write(self, key: str, data: bytes) -> None:
        self._require_storage()
        self._storage.write(key, data)

    def _end(self, outcome: Outcome) -> Files:
        with self._telling:
            artifacts = dict(self._files.artifacts)
            # The process of a batch itself has put its shards into the storage.
            for name in () if is_in_shards(self._row.summary) else outcome.artifacts:
                if name not in artifacts:
                    path, sha256 = self._folder.artifacts / name, outcome.sha256.get(name)
                    artifacts[name] = self._upload(path, f"artifacts/{name}", sha256)
            run: Mapping[str, StoredFile] = {}
            if outcome.error is not None:  # a retry goes on from it
                run = self._new_run(is_last=True) or self._files.run
            log = self._log.pieces(self._files.log, everything=True)
            self._files = replace(self._files, log=log, run=run, artifacts=artifacts)
            return self._files

    def _note_away(self, error: Exception) -> None:
        if not self._is_away:
            _log.warning(f"the job {self._row.id} is told later: {error}")
        self._is_away = True

    def _note_back(self) -> None:
        if self._is_away:
            _log.warning("it is told of the job again")
        self._is_away = False


class _GrowingFile:
    """A file to whose end a process writes, as pieces in the storage."""

    def __init__(self, write: Callable[[str, bytes], object], path: Path, key: str) -> None:
        self._write, self._path, self._key = write, path, key
        self._own: list[Piece] = []

    def pieces(self, before: tuple[Piece, ...], *, everything: bool) -> tuple[Piece, ...]:
        """The pieces `before` this attempt's, and this attempt's, of which new bytes have been written."""
        inherited = [piece for piece in before if not piece.key.startswith(f"{self._key}-")]
        offset, budget = sum(piece.bytes for piece in self._own), MOST_BYTES
        with contextlib.suppress(FileNotFoundError), self._path.open("rb") as file:
            if self._path.stat().st_size < offset:  # a journal that was ahead of its checkpoint was cut
                self._own, offset = [], 0
            while everything or budget > 0:
                is_full = not self._own or self._own[-1].bytes >= PIECE_BYTES
                begin = offset if is_full else offset - self._own[-1].bytes
                file.seek(begin)
                data = file.read(PIECE_BYTES)
                if begin + len(data) == offset:
                    break
                number = len(self._own) if is_full else len(self._own) - 1
                piece = Piece(f"{self._key}-{number:05d}", len(data))
                self._write(piece.key, data)
                self._own[number:] = [piece]
                budget -= begin + len(data) - offset
                offset = begin + len(data)
        return (*inherited, *self._own)


def copy_run(run: Path, version: _Version, target: Path) -> bool:
    """Puts a run as it is at one moment into a new folder; False where it is not of this version (any more).

    Links to what is replaced whole: that stays as it is when the process of the job replaces it. What grows comes
    after it: a journal that is ahead is cut where a training goes on.
    """
    target.mkdir()
    try:
        for name in version:
            _place(target, name).hardlink_to(run / name)
        for path in _run_files(run):
            if _is_beside(path):
                shutil.copyfile(path, _place(target, path.relative_to(run).as_posix()))
    except FileNotFoundError:
        return False
    return _version_of(run) == version


def _version_of(run: Path) -> _Version:
    """The version of a run; empty where there is nothing to go on from."""
    times_ns = {}
    for path in _run_files(run):
        if not _is_beside(path):
            with contextlib.suppress(FileNotFoundError):  # replaced or removed meanwhile
                times_ns[path.relative_to(run).as_posix()] = path.stat().st_mtime_ns
    return times_ns


def _run_files(folder: Path) -> Iterator[Path]:
    for path in folder.rglob("*"):
        if path.is_file() and not (path.name.startswith(".") and path.name.endswith(TEMPORARY_SUFFIX)):
            yield path


def _is_beside(path: Path) -> bool:
    return path.name in _BESIDE or path.suffix == _PICTURE


def _place(target: Path, name: str) -> Path:
    path = target / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _in_thread(work: Callable[[], _T]) -> Future[_T]:
    """Begins work that a worker which stops does not wait for."""
    future: Future[_T] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, name="telling-work", daemon=True).start()
    return future
