"""A dataset on its way into the store: a folder `.incoming-*`, locked as long as its service lives. Free of torch."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import secrets
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from ultragray.errors import DatasetInvalid, StorageFull

from .store import DELETED_PREFIX, FILES_NAME, DatasetRecord, DatasetStore
from .unpack import FileBudget, create_below

PREFIX = ".incoming-"
LOCK_NAME, ARCHIVE_NAME, DATASET_NAME = "lock", "archive", "dataset"
_LOCKED_WITHIN_S = 60.0  # a folder this young without a lock is being made
_DELETED_WITHIN_S = 60.0  # a folder renamed this lately may yet be given back


class IncomingDataset:
    """Takes files, or one archive, then becomes a dataset or goes without a trace.

    Its methods block, so they run in threads; one at a time. `discard` may come at any moment: a method that runs or
    comes later raises ValueError.
    """

    def __init__(self, store: DatasetStore, max_bytes: int) -> None:
        """Makes the folder. Raises StorageFull."""
        self._store = store
        self._budget = FileBudget(max_bytes)
        self._using = threading.Lock()
        self._file: IO[bytes] | None = None
        with storage_full("the dataset"):
            store.folder.mkdir(parents=True, exist_ok=True)
            self.folder = store.folder / f"{PREFIX}{secrets.token_hex(8)}"
            self.folder.mkdir()
            self._lock: IO[bytes] | None = (self.folder / LOCK_NAME).open("wb")
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            (self.folder / DATASET_NAME / FILES_NAME).mkdir(parents=True)

    def begin_file(self, name: str) -> None:
        """What is written next belongs to the file `name`. Raises DatasetInvalid, UploadTooLarge, StorageFull."""
        with self._open():
            self._finish_file()
            self._budget.take_file()
            self._file = create_below(self.folder / DATASET_NAME / FILES_NAME, name)

    def begin_archive(self) -> None:
        """What is written next is one archive. Raises StorageFull."""
        with self._open():
            self._file = (self.folder / ARCHIVE_NAME).open("xb")

    def write(self, data: bytes) -> None:
        """Raises UploadTooLarge, StorageFull, and DatasetInvalid before the first file."""
        with self._open():
            if self._file is None:
                raise DatasetInvalid("the upload must name a file before its bytes")
            self._budget.take_bytes(len(data))
            self._file.write(data)

    def finish(self) -> None:
        """All has been written. Raises StorageFull."""
        with self._open():
            self._finish_file()

    def accept(self, name: str) -> tuple[DatasetRecord, bool]:
        """Makes the checked dataset one of the store, as `DatasetStore.add`."""
        with self._open():
            return self._store.add(self.folder / DATASET_NAME, name)

    def discard(self) -> None:
        """Removes what has not become a dataset."""
        with self._using:
            if self._lock is None:
                return
            if self._file is not None:
                with contextlib.suppress(OSError):
                    self._file.close()
            shutil.rmtree(self.folder, ignore_errors=True)
            self._lock.close()
            self._lock = None

    @contextlib.contextmanager
    def _open(self) -> Iterator[None]:
        with self._using:
            if self._lock is None:
                raise ValueError("the upload was discarded")
            with storage_full("the dataset"):
                yield

    def _finish_file(self) -> None:
        if self._file is not None:
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            self._file = None


def remove_stale(store: DatasetStore) -> int:
    """Removes what dead services left of uploads and deletions; how many. Uploads of live ones, anywhere, stay."""
    removed = 0
    for folder in list(store.folder.glob(f"{PREFIX}*")):
        with _unless_locked(folder) as stale:
            if stale:
                shutil.rmtree(folder, ignore_errors=True)
                removed += 1
    for folder in list(store.folder.glob(f"{DELETED_PREFIX}*")):
        with contextlib.suppress(FileNotFoundError):
            if time.time() - folder.stat().st_ctime > _DELETED_WITHIN_S:
                shutil.rmtree(folder, ignore_errors=True)
                removed += 1
    return removed


@contextlib.contextmanager
def _unless_locked(folder: Path) -> Iterator[bool]:
    try:
        with (folder / LOCK_NAME).open("rb+") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                yield False
            else:
                yield True
    except FileNotFoundError:
        with contextlib.suppress(FileNotFoundError):
            yield time.time() - folder.stat().st_mtime > _LOCKED_WITHIN_S
            return
        yield False


@contextlib.contextmanager
def storage_full(what: str) -> Iterator[None]:
    """Raises StorageFull where a disk has no room."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise StorageFull(f"the artifact folder has no room for {what}") from error
        raise
