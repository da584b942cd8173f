"""Work of a helper process: unpacking and checking an upload. Where it succeeds the folder holds a complete dataset."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

from ultragray.errors import DatasetInvalid, UltragrayError
from ultragray.files.atomic import sync

from ..claims import storage_full
from .incoming import ARCHIVE_NAME, DATASET_NAME
from .store import CONTACT_SHEET_NAME, FILES_NAME, DatasetRecord, write_manifest
from .unpack import unpack

if TYPE_CHECKING:
    from ultragray.datasets import Dataset

CONFIG_NAME = "conf.json"
RELEASED, PLUS = "released", "plus"
_NAMES_IN_MESSAGE = 5
_OPTIONS = {f"--{name.replace('_', '-')}": name for name in ("train_frames", "val_frames", "image_size")} | {
    "--crop": "crop",
    "--frames": "frames",
}


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
    """Reads the dataset of a folder as the command line does and draws its contact sheet. Raises DatasetInvalid."""
    from ultragray.datasets.checks import check_dataset
    from ultragray.datasets.pictures import draw_dataset
    from ultragray.datasets.source import SourceOptions, load_dataset

    kind, source, device_set = find_source(files)
    if kind == RELEASED:
        _require_own_files(source, files)
    dataset: Dataset = load_dataset(source, SourceOptions(**options, device_set=device_set))
    dataset = replace(dataset, name=name)
    report = check_dataset(dataset)
    draw_dataset(dataset, contact_sheet)
    return DatasetRecord(
        name=name,
        kind=kind,
        sha256=dataset.sha256,
        bytes=sum(path.stat().st_size for path in files.rglob("*") if path.is_file()),
        created_at=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        train_frames=len(dataset.train),
        val_frames=len(dataset.val),
        height=dataset.train.height,
        width=dataset.train.width,
        probe=dataset.probe,
        warnings=report.labelled_warnings,
        source=str(source.relative_to(files)),
        device_set=None if device_set is None else str(device_set.relative_to(files)),
        options=options,
    )


def find_source(files: Path) -> tuple[str, Path, Path | None]:
    """Kind, source and device set of the one dataset below a folder. Raises DatasetInvalid."""
    from ultragray.datasets.plus import SEQUENCE_SUFFIXES

    relative = sorted(path.relative_to(files) for path in files.rglob("*") if path.is_file())
    plain = [path for path in relative if not any(part.startswith((".", "__MACOSX")) for part in path.parts)]
    configs = [path for path in plain if path.name == CONFIG_NAME]
    sequences = [path for path in plain if path.suffix.lower() in SEQUENCE_SUFFIXES]
    device_sets = [path for path in plain if path.suffix.lower() == ".xml"]
    if not configs and not sequences:
        raise DatasetInvalid(
            f"the upload holds neither {CONFIG_NAME} nor a PLUS sequence ({', '.join(SEQUENCE_SUFFIXES)}), "
            f"it holds {_listed(plain) or 'no files'}"
        )
    if len(configs) + len(sequences) > 1:
        raise DatasetInvalid(f"the upload must hold one dataset, it holds {_listed([*configs, *sequences])}")
    if configs:
        return RELEASED, files / configs[0], None
    if len(device_sets) > 1:
        raise DatasetInvalid(f"the upload must hold at most one device set (.xml), it holds {_listed(device_sets)}")
    return PLUS, files / sequences[0], files / device_sets[0] if device_sets else None


def _require_own_files(config_path: Path, files: Path) -> None:
    """conf.json may name any path of the machine: only files of the upload are read."""
    from ultragray.errors import CheckpointInvalid
    from ultragray.interchange.released_config import read_released_config

    try:
        config = read_released_config(config_path)
    except CheckpointInvalid as error:
        raise DatasetInvalid(error.detail) from error
    for key, named in config.files.items():
        found = config.find(key)
        if found is None or not found.resolve().is_relative_to(files):
            raise DatasetInvalid(f"{config_path}: {key} names {named[:200]!r}, which is not in the upload")


def _listed(paths: list[Path]) -> str:
    shown = ", ".join(map(str, paths[:_NAMES_IN_MESSAGE]))
    return shown + (f" and {len(paths) - _NAMES_IN_MESSAGE} more" if len(paths) > _NAMES_IN_MESSAGE else "")


@contextlib.contextmanager
def _in_words_of_the_upload(files: Path) -> Iterator[None]:
    """Errors name files as the upload does, and options as requests write them."""
    try:
        yield
    except UltragrayError as error:
        detail = error.detail.replace(f"{files}{os.sep}", "").replace(str(files), "the upload")
        for option, name in _OPTIONS.items():
            detail = detail.replace(option, name)
        field = None if error.field is None else _OPTIONS.get(error.field, error.field)
        raise type(error)(detail, field=field) from error
