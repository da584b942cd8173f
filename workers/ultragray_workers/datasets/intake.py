"""A data set on its way into the store: received into a folder, unpacked, checked, and complete. Free of torch.

The service writes what it is sent into an `IncomingDataset`. `take_in` is the work of a helper process: where it
succeeds the folder holds a complete data set.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import IO

from ultragray.datasets.released import write_released
from ultragray.datasets.source import find_source, load_dataset, options_of
from ultragray.errors import DatasetInvalid, UltragrayError
from ultragray.files import sync
from ultragray_workers.claims import claimed_folder, remove_abandoned, storage_full
from ultragray_workers.datasets.recording import Recordings, recorded_dataset
from ultragray_workers.datasets.store import (
    CONTACT_SHEET_NAME,
    FILES_NAME,
    DatasetRecord,
    DatasetStore,
    write_manifest,
)
from ultragray_workers.datasets.unpack import FileBudget, create_below, unpack
from ultragray_workers.storage.location import open_storage

PREFIX = ".incoming-"
ARCHIVE_NAME, DATASET_NAME = "archive", "dataset"


class IncomingDataset:
    """Takes files, or one archive, then becomes a dataset or goes without a trace.

    Its methods block, so they run in threads; one at a time. `discard` may come at any moment: a method that runs or
    comes later raises ValueError.
    """

    def __init__(self, store: DatasetStore, max_bytes: int) -> None:
        """Makes the folder. Raises StorageFull."""
        self.store = store
        self._budget = FileBudget(max_bytes)
        self._using = threading.Lock()
        self._file: IO[bytes] | None = None
        self._discarded = False
        with storage_full("the dataset"), contextlib.ExitStack() as stack:
            self.folder = stack.enter_context(claimed_folder(store.folder, PREFIX))
            stack.enter_context(store.storage.claimed(self.folder.name))
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
        with self._open():
            self._finish_file()

    def is_there(self, name: str, claim: str | None) -> bool:
        """Whether there is a dataset of that name, or the upload of a claim is about to make it.

        In the other order a dataset that appears in between would be missed.
        """
        return (claim is not None and self.store.storage.is_claimed(claim)) or self.store.is_taken(name)

    def present(self, name: str) -> DatasetRecord:
        with self._open():
            return self.store.present(self.folder / DATASET_NAME, name)

    def accept(self, name: str) -> tuple[DatasetRecord, bool]:
        with self._open():
            return self.store.add(self.folder / DATASET_NAME, name)

    def discard(self) -> None:
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


def take_in(
    folder: str,
    name: str,
    options: dict[str, str],
    max_bytes: int,
    *,
    simulated: bool = False,
    recorded: str | None = None,
) -> None:
    """Complete the dataset in the folder of an IncomingDataset: unpacked, checked, with contact sheet and manifest.

    `simulated`: it holds nothing, and gets the built-in phantom; `recorded`: the frames of the recording of its name,
    in the storage at that location.
    Raises DatasetInvalid with the file and the frame, InvalidArgument for an option, UploadTooLarge, StorageFull.
    """
    incoming = Path(folder).resolve()
    dataset_folder = incoming / DATASET_NAME
    files = dataset_folder / FILES_NAME
    with _in_words_of_the_upload(files), storage_full("the dataset"):
        archive = incoming / ARCHIVE_NAME
        if archive.exists():
            unpack(archive, files, max_bytes)
            archive.unlink()
        if simulated:
            _simulate(files, max_bytes)
        remarks: tuple[str, ...] = ()
        if recorded is not None:
            dataset, remarks = recorded_dataset(Recordings(open_storage(recorded)), name)
            write_released(dataset, files)
        record = check_files(files, name, options, dataset_folder / CONTACT_SHEET_NAME)
        record = replace(record, warnings=(*record.warnings, *remarks))
        for path in (*(path for path in files.rglob("*") if path.is_dir()), files):
            sync(path)
        write_manifest(record, dataset_folder)


def _simulate(files: Path, max_bytes: int) -> None:
    """Writes the built-in phantom. Raises UploadTooLarge."""
    from ultragray.phantom import load_phantom

    write_released(load_phantom(), files)
    FileBudget(max_bytes).take_bytes(sum(path.stat().st_size for path in files.iterdir()))


def check_files(files: Path, name: str, options: dict[str, str], contact_sheet: Path) -> DatasetRecord:
    """Read the dataset of a folder as the command line does and draw its contact sheet. Raises DatasetInvalid."""
    from ultragray.datasets.checks import check_dataset
    from ultragray.datasets.pictures import draw_dataset

    source = find_source(files)
    source.format.check_upload(source.path, files)
    dataset = replace(load_dataset(files, options_of(options)), name=name)
    report = check_dataset(dataset)
    draw_dataset(dataset, contact_sheet)
    return DatasetRecord(
        name=name,
        kind=source.format.name,
        sha256=dataset.sha256,
        bytes=sum(path.stat().st_size for path in files.rglob("*") if path.is_file()),
        created_at=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        train_frames=len(dataset.train),
        val_frames=len(dataset.val),
        height=dataset.train.height,
        width=dataset.train.width,
        probe=dataset.probe,
        warnings=report.warnings,
        options=options,
        region=dataset.train.region,
    )


@contextlib.contextmanager
def _in_words_of_the_upload(files: Path) -> Iterator[None]:
    """Errors name files as the upload does."""
    try:
        yield
    except UltragrayError as error:
        detail = error.detail.replace(f"{files}{os.sep}", "").replace(str(files), "the upload")
        raise type(error)(detail, field=error.field) from error
