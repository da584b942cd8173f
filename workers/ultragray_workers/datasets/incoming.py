"""A dataset on its way into the store, in a folder claimed as long as its service lives. Free of torch."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from ultragray.errors import DatasetInvalid
from ultragray.files import sync
from ultragray_workers.claims import claimed_folder, remove_abandoned, storage_full
from ultragray_workers.datasets.shelf import FILES_NAME
from ultragray_workers.datasets.store import DatasetRecord, DatasetStore
from ultragray_workers.datasets.unpack import FileBudget, create_below

PREFIX = ".incoming-"
ARCHIVE_NAME, DATASET_NAME = "archive", "dataset"


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
        self._discarded = False
        with storage_full("the dataset"), contextlib.ExitStack() as stack:
            self.folder = stack.enter_context(claimed_folder(store.folder, PREFIX))
            stack.enter_context(store.shelf.storage.claimed(self.folder.name))
            (self.folder / DATASET_NAME / FILES_NAME).mkdir(parents=True)
            self._claim = stack.pop_all()

    def begin_file(self, name: str) -> None:
        """Begin the file `name`: what is written next belongs to it.

        Raises DatasetInvalid, UploadTooLarge, StorageFull.
        """
        with self._open():
            self._finish_file()
            self._budget.take_file()
            self._file = create_below(self.folder / DATASET_NAME / FILES_NAME, name)

    def begin_archive(self) -> None:
        """Begin the one archive that is written next. Raises StorageFull."""
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
        """End the last file. Raises StorageFull."""
        with self._open():
            self._finish_file()

    def is_taken(self, name: str) -> bool:
        """Whether there is a dataset of that name already."""
        return self._store.is_taken(name)

    def is_there(self, name: str, claim: str | None) -> bool:
        """Whether there is a dataset of that name, or the upload of a claim is about to make it.

        In the other order a dataset that appears in between would be missed.
        """
        return (claim is not None and self._store.shelf.storage.is_claimed(claim)) or self._store.is_taken(name)

    def present(self, name: str) -> DatasetRecord:
        """As `DatasetStore.present`."""
        with self._open():
            return self._store.present(self.folder / DATASET_NAME, name)

    def accept(self, name: str) -> tuple[DatasetRecord, bool]:
        """Make the checked dataset one of the store, as `DatasetStore.add`."""
        with self._open():
            return self._store.add(self.folder / DATASET_NAME, name)

    def discard(self) -> None:
        """Remove what has not become a dataset."""
        with self._using:
            if self._file is not None:
                with contextlib.suppress(OSError):
                    self._file.close()
            self._claim.close()
            self._discarded = True

    @contextlib.contextmanager
    def _open(self) -> Iterator[None]:
        with self._using:
            if self._discarded:
                raise ValueError("the upload was discarded")
            with storage_full("the dataset"):
                yield

    def _finish_file(self) -> None:
        if self._file is not None:
            self._file.close()
            sync(Path(self._file.name))
            self._file = None


def remove_stale(store: DatasetStore) -> int:
    """Remove what dead services left of uploads; how many. Uploads of live ones, anywhere, stay."""
    return remove_abandoned(store.folder, PREFIX)
