"""Work of a helper process: unpacking and checking an upload. Where it succeeds the folder holds a complete dataset."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

from ultragray.errors import UltragrayError
from ultragray.files import sync
from ultragray_workers.claims import storage_full
from ultragray_workers.datasets.incoming import ARCHIVE_NAME, DATASET_NAME
from ultragray_workers.datasets.shelf import CONTACT_SHEET_NAME, FILES_NAME
from ultragray_workers.datasets.store import DatasetRecord, find_source, write_manifest
from ultragray_workers.datasets.unpack import unpack


def take_in(folder: str, name: str, options: dict[str, str], max_bytes: int) -> None:
    """Complete the dataset in the folder of an IncomingDataset: unpacked, checked, with contact sheet and manifest.

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
        record = check_files(files, name, options, dataset_folder / CONTACT_SHEET_NAME)
        for path in (*(path for path in files.rglob("*") if path.is_dir()), files):
            sync(path)
        write_manifest(record, dataset_folder)


def check_files(files: Path, name: str, options: dict[str, str], contact_sheet: Path) -> DatasetRecord:
    """Read the dataset of a folder as the command line does and draw its contact sheet. Raises DatasetInvalid."""
    from ultragray.datasets.checks import check_dataset
    from ultragray.datasets.pictures import draw_dataset

    uploaded = find_source(files)
    uploaded.format.check_upload(uploaded.path, files)
    dataset = replace(uploaded.load(options), name=name)
    report = check_dataset(dataset)
    draw_dataset(dataset, contact_sheet)
    return DatasetRecord(
        name=name,
        kind=uploaded.format.name,
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
