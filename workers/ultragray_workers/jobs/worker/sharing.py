"""The job of a worker beyond its host: taken over from a shared storage, and told to it as it goes on.

The worker and the job's process work in a folder of their host as ever. A thread tells the storage what changes there;
while the storage is away the work goes on, and what was missed is told when it is back. Free of torch.
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
from typing import Protocol, TypeVar

from ultragray.errors import TrainingStateInvalid
from ultragray.files import file_sha256
from ultragray_workers.errors import StorageUnavailable
from ultragray_workers.jobs.folder import JobFolder, Outcome
from ultragray_workers.jobs.shared.record import (
    JobRecord,
    LogPiece,
    StoredFile,
    Superseded,
    batch_prefix_of,
    change,
    claim,
    prefix_of,
    read_record,
    record_key,
)
from ultragray_workers.jobs.shared.run_files import Version, copy_of, files_in, version_of
from ultragray_workers.storage.storage import NotThere, Storage

TELL_INTERVAL_S = 1.0
LAST_WAIT_S = 10.0  # for what a job leaves that goes on elsewhere
PIECE_BYTES = 256 * 1024  # of the log: the last piece is written again when it has grown
MOST_LOG_BYTES = 4 * PIECE_BYTES  # of the log, told at once
_RETRY_S, _LONGEST_RETRY_S = 0.5, 10.0
_LOOK_S = 0.25

_log = logging.getLogger("ultragray.jobs")
_T = TypeVar("_T")


class Sharing(Protocol):
    """What the hosts of a queue know of the job at hand."""

    def take_over(self) -> None:
        """Makes the job's folder, with what an earlier worker left of the job. Raises Superseded, OSError."""

    def telling(self) -> contextlib.AbstractContextManager[None]:
        """Tells during the body what the job's process does."""

    def tell_last(self) -> None:
        """Tells what there is of a job that goes on elsewhere, or was cancelled, unless that takes long."""

    def end(self, outcome: Outcome) -> None:
        """Tells the end of the job, with all that it made. Raises Superseded."""

    def patiently(self, work: Callable[[], _T]) -> _T:
        """What the work gives, tried again while a storage is away."""

    def forget(self) -> None:
        """Removes what this host alone has of the job at hand."""


class InOneFolder:
    """The job's folder is the one that all workers and services see: there is nothing to tell."""

    def __init__(self, folder: JobFolder, submission: str | None, needed: str | None) -> None:
        self._folder, self._submission, self._needed = folder, submission, needed

    def take_over(self) -> None:
        """As `Sharing`."""
        self._folder.begin(self._submission, self._needed)

    def telling(self) -> contextlib.AbstractContextManager[None]:
        """As `Sharing`."""
        return contextlib.nullcontext()

    def tell_last(self) -> None:
        """As `Sharing`."""

    def end(self, outcome: Outcome) -> None:
        """As `Sharing`."""

    def patiently(self, work: Callable[[], _T]) -> _T:
        """As `Sharing`."""
        return work()

    def forget(self) -> None:
        """As `Sharing`."""


class ThroughStorage:
    """The job's folder is this host's own."""

    def __init__(
        self,
        storage: Storage,
        folder: JobFolder,
        *,
        submission: str | None,
        attempt: int,
        needed: str | None,
        retry_of: str | None,
        watch: Callable[[], None],
        is_in_shards: bool = False,
    ) -> None:
        """`needed`: the file of the scene that the job needs. `is_in_shards`: the job's process itself puts what can be
        downloaded into the storage. `watch`: called while something takes long; what it
        raises ends that.
        """
        self._storage, self._folder = storage, folder
        self._submission, self._attempt = submission, attempt
        self._needed, self._retry_of, self._watch = needed, retry_of, watch
        self._is_in_shards = is_in_shards
        self._record: JobRecord | None = None
        self._telling = threading.Lock()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._is_away = False
        self._own_log: list[LogPiece] = []
        self._run_version: Version = {}  # of the checkpoint that was told last
        self._run_files: dict[str, StoredFile] = {}  # of that version, as far as this attempt has uploaded them
        self._runs = 0
        self._uploading: Future[dict[str, StoredFile] | None] | None = None

    def take_over(self) -> None:
        """As `Sharing`; waits for a storage that is away."""
        self.patiently(self._take_over)

    @contextlib.contextmanager
    def telling(self) -> Iterator[None]:
        """As `Sharing`."""
        self._thread = threading.Thread(target=self._tell_now_and_then, name="sharing", daemon=True)
        self._thread.start()
        try:
            yield
        except BaseException:
            self.tell_last()
            raise
        finally:
            self._ended.set()

    def tell_last(self) -> None:
        """As `Sharing`."""
        self._ended.set()
        if self._record is None or self._record.outcome is not None:
            return
        last = _in_thread(lambda: self._tell(is_last=True))
        wait([last], LAST_WAIT_S)
        if not last.done() or last.exception() is not None:
            _log.warning(f"the end of the work at the job {self._folder.job_id} here could not be told to others")

    def end(self, outcome: Outcome) -> None:
        """As `Sharing`; waits for a storage that is away."""
        self._ended.set()
        self.patiently(lambda: self._end(outcome))

    def forget(self) -> None:
        """As `Sharing`."""
        self._ended.set()
        shutil.rmtree(self._folder.path, ignore_errors=True)

    def _key(self, name: str) -> str:
        assert self._record is not None
        return f"{prefix_of(self._folder.job_id)}/{self._record.writer}/{name}"

    def _take_over(self) -> None:
        folder, job_id = self._folder, self._folder.job_id
        record = claim(self._storage, job_id, self._submission, self._attempt)
        folder.path.mkdir(parents=True, exist_ok=True)
        for path in folder.path.iterdir():
            if path == folder.lock:
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        if self._needed is not None:
            with contextlib.suppress(NotThere):  # then the process says so
                self._storage.download(f"{prefix_of(job_id)}/{self._needed}", folder.path / self._needed)
        folder.write_progress(record.progress)
        if record.outcome is not None:
            self._fetch(record.artifacts, folder.artifacts)
            folder.write_outcome(record.outcome)
        elif record.run:
            self._fetch(record.run, folder.run)
        elif self._retry_of is not None:
            before = read_record(self._storage, self._retry_of)
            # One that could not be resumed from is no beginning.
            if before and not (before.outcome and before.outcome.error == TrainingStateInvalid.reason):
                self._fetch(before.run, folder.run)
        self._record = record
        self._run_version = version_of(folder.run)

    def _fetch(self, files: Mapping[str, StoredFile], target: Path) -> None:
        """Copies files into a new folder, all of them or, where one is gone or damaged, none."""
        partial = target.with_name(f"{target.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        for name, stored in files.items():
            (partial / name).parent.mkdir(parents=True, exist_ok=True)
            try:
                self._storage.download(stored.key, partial / name)
            except NotThere:
                _log.warning(f"{stored.key} is not there any more: the job {self._folder.job_id} does without")
                break
            if file_sha256(partial / name) != stored.sha256:
                _log.warning(f"{stored.key} is damaged: the job {self._folder.job_id} does without")
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
            except (StorageUnavailable, OSError) as error:
                self._note_away(error)
                pause_s = min(2.0 * pause_s, _LONGEST_RETRY_S)
            except Superseded:  # the queue will say so, too
                return
            else:
                self._note_back()
                pause_s = TELL_INTERVAL_S

    def _tell(self, *, is_last: bool) -> None:
        with self._telling:
            record = self._record
            assert record is not None
            progress, log = self._folder.progress(), self._told_log(everything=is_last)
            run = self._told_run(is_last=is_last)
            if progress == record.progress and log == record.log and run is None:
                return
            self._change(
                lambda before: replace(before, progress=progress, log=log, run=before.run if run is None else run)
            )
            if run is not None:
                self._remove(record.run, keep=run)

    def _told_log(self, *, everything: bool) -> tuple[LogPiece, ...]:
        """The pieces of the log, of which new bytes have been written."""
        assert self._record is not None
        inherited = [piece for piece in self._record.log if not piece.key.startswith(self._key("log-"))]
        told, left = sum(piece.bytes for piece in self._own_log), MOST_LOG_BYTES
        try:
            with self._folder.log.open("rb") as file:
                while everything or left > 0:
                    is_full = not self._own_log or self._own_log[-1].bytes >= PIECE_BYTES
                    begin = told if is_full else told - self._own_log[-1].bytes
                    file.seek(begin)
                    data = file.read(PIECE_BYTES)
                    if begin + len(data) == told:
                        break
                    number = len(self._own_log) if is_full else len(self._own_log) - 1
                    piece = LogPiece(self._key(f"log-{number:05d}"), len(data))
                    self._storage.write(piece.key, data)
                    self._own_log[number:] = [piece]
                    left -= begin + len(data) - told
                    told = begin + len(data)
        except FileNotFoundError:
            pass
        return (*inherited, *self._own_log)

    def _told_run(self, *, is_last: bool) -> dict[str, StoredFile] | None:
        """The files of a new checkpoint that are there whole; None: there is none since the last one."""
        uploaded: dict[str, StoredFile] | None = None
        if self._uploading is not None and (is_last or self._uploading.done()):
            uploading, self._uploading = self._uploading, None
            uploaded = uploading.result()
        version = version_of(self._folder.run)
        if self._uploading is None and version and version != self._run_version:
            if is_last:
                return self._upload_run(version)
            self._uploading = _in_thread(lambda: self._upload_run(version))
        return uploaded

    def _upload_run(self, version: Version) -> dict[str, StoredFile] | None:
        """Uploads what is new of the checkpoint; None where it has changed already: then the next one is told."""
        self._runs += 1
        number, copies = self._runs, self._folder.path / f"sharing-{self._runs}"
        shutil.rmtree(copies, ignore_errors=True)
        try:
            if not copy_of(self._folder.run, version, copies):
                return None
            stored = {
                name: self._run_files[name]
                if name in self._run_files and version.get(name, 0) == self._run_version.get(name)
                else self._upload(path, f"run-{number}/{name}")
                for name, path in files_in(copies).items()
            }
        finally:
            shutil.rmtree(copies, ignore_errors=True)
        self._run_version, self._run_files = version, stored
        return stored

    def _upload(self, path: Path, name: str) -> StoredFile:
        stored = StoredFile(self._key(name), path.stat().st_size, file_sha256(path))
        self._storage.upload(path, stored.key)
        return stored

    def _end(self, outcome: Outcome) -> None:
        with self._telling:
            record = self._record
            assert record is not None
            if record.outcome == outcome:
                return
            artifacts = dict(record.artifacts)
            for name in () if self._is_in_shards else outcome.artifacts:
                if name not in artifacts:
                    artifacts[name] = self._upload(self._folder.artifacts / name, f"artifacts/{name}")
            run: Mapping[str, StoredFile] = {}
            if outcome.error is not None:  # a retry goes on from it
                run = self._told_run(is_last=True) or record.run
            log = self._told_log(everything=True)
            self._change(
                lambda before: replace(
                    before, progress=outcome.progress, log=log, run=run, artifacts=artifacts, outcome=outcome
                )
            )
            self._remove_unnamed()

    def _change(self, changed: Callable[[JobRecord], JobRecord]) -> None:
        assert self._record is not None
        self._record = change(self._storage, self._folder.job_id, self._record.writer, changed)

    def _remove(self, old: Mapping[str, StoredFile], keep: Mapping[str, StoredFile]) -> None:
        for key in {one.key for one in old.values()} - {one.key for one in keep.values()}:
            self._storage.delete(key)

    def _remove_unnamed(self) -> None:
        """Removes what earlier attempts left, but for the scene that was kept for the job, and shards."""
        assert self._record is not None
        top = prefix_of(self._folder.job_id)
        named = {*self._record.keys(), record_key(self._folder.job_id)}
        for entry in list(self._storage.entries(top)):
            is_writers = "/" in entry.key.removeprefix(f"{top}/")
            is_shard = entry.key.startswith(f"{batch_prefix_of(self._folder.job_id)}/")
            if entry.key not in named and is_writers and not is_shard:
                self._storage.delete(entry.key)

    def patiently(self, work: Callable[[], _T]) -> _T:
        """As `Sharing`, in a thread. Raises what `watch` raises meanwhile."""
        pause_s = _RETRY_S
        while True:
            future = _in_thread(work)
            while not future.done():
                self._watch()
                wait([future], _LOOK_S)
            try:
                found = future.result()
            except StorageUnavailable as error:
                self._note_away(error)
            else:
                self._note_back()
                return found
            end_s = time.monotonic() + pause_s
            while time.monotonic() < end_s:
                self._watch()
                time.sleep(_LOOK_S)
            pause_s = min(2.0 * pause_s, _LONGEST_RETRY_S)

    def _note_away(self, error: Exception) -> None:
        if not self._is_away:
            _log.warning(f"the job {self._folder.job_id} is told later: {error}")
        self._is_away = True

    def _note_back(self) -> None:
        if self._is_away:
            _log.warning("the storage is back: it is told of the job again")
        self._is_away = False


def _in_thread(work: Callable[[], _T]) -> Future[_T]:
    """Begins work that a worker which stops does not wait for."""
    future: Future[_T] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, name="sharing-work", daemon=True).start()
    return future
