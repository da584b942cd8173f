"""The datasets at a place that a process is told in words."""

from __future__ import annotations

from pathlib import Path

from ultragray_workers.datasets.copies import DEFAULT_MAX_BYTES
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.storage.opening import open_storage


def open_datasets(
    artifact_folder: str | Path, storage: str | None, max_copies_bytes: int = DEFAULT_MAX_BYTES
) -> DatasetStore:
    """Those of a storage that several hosts share, with copies below the folder; None: those of the folder."""
    shared = None if storage is None else open_storage(storage)
    return DatasetStore(Path(artifact_folder), shared, max_copies_bytes)
