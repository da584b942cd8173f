"""Copies the datasets of an artifact folder into a storage that hosts share."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ultragray_workers.datasets.shared_shelf import SharedShelf, without_shared_files
from ultragray_workers.datasets.shelf import FolderShelf
from ultragray_workers.datasets.store import FOLDER
from ultragray_workers.errors import RestoreRefused
from ultragray_workers.storage.storage import Storage


@dataclass(frozen=True)
class CopiedDatasets:
    """What a copy has done."""

    datasets: int = 0
    datasets_already_there: int = 0


def copy_datasets(
    artifact_folder: Path, target: Storage, say: Callable[[str], None] = lambda sentence: None
) -> CopiedDatasets:
    """Copies the datasets of a folder that the storage of artifacts `target` has not, each whole or not at all.

    Interrupted, the same call goes on with those that are missing. Raises RestoreRefused where the target has another
    dataset of a name, StorageUnavailable, OSError.
    """
    source, copied, there = FolderShelf(artifact_folder / FOLDER), 0, 0
    names = sorted(source.names())
    with tempfile.TemporaryDirectory(prefix="ultragray-copy-") as nowhere:
        shelf = SharedShelf(target, Path(nowhere))
        for number, name in enumerate(names, 1):
            is_new = shelf.manifest(name) is None and shelf.put(artifact_folder / FOLDER / name, name)
            if not is_new and _document(shelf.manifest(name)) != _document(source.manifest(name)):
                raise RestoreRefused(
                    f"{target.location} has another dataset {name!r}: delete it there, or choose another place"
                )
            copied, there = copied + is_new, there + (not is_new)
            say(f"{number} of {len(names)}: dataset {name} {'copied' if is_new else 'is there already'}")
    return CopiedDatasets(copied, there)


def _document(manifest: str | None) -> dict[str, Any] | None:
    return None if manifest is None else without_shared_files(json.loads(manifest))
