"""Copies the datasets of one storage into another, such as from a folder into a bucket."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ultragray_workers.datasets.shelf import DatasetShelf, without_files
from ultragray_workers.errors import RestoreRefused
from ultragray_workers.storage.storage import Storage


@dataclass(frozen=True)
class CopiedDatasets:
    """What a copy has done."""

    datasets: int = 0
    datasets_already_there: int = 0


def copy_datasets(
    source: Storage, target: Storage, say: Callable[[str], None] = lambda sentence: None
) -> CopiedDatasets:
    """Copies the datasets that the target has not, each whole or not at all.

    Interrupted, the same call goes on with those that are missing. Raises RestoreRefused where the target has another
    dataset of a name, StorageUnavailable, OSError.
    """
    copied = there = 0
    with tempfile.TemporaryDirectory(prefix="ultragray-copy-") as copies:
        here, shelf = DatasetShelf(source, Path(copies, "from")), DatasetShelf(target, Path(copies, "to"))
        names = sorted(here.names())
        for number, name in enumerate(names, 1):
            manifest = here.manifest(name)
            if manifest is None:  # deleted meanwhile
                continue
            with here.folder(name) as folder:
                is_new = shelf.manifest(name) is None and shelf.put(folder, manifest, name)
            found = shelf.manifest(name)
            if not is_new and (found is None or without_files(found) != without_files(manifest)):
                raise RestoreRefused(
                    f"{target.location} has another dataset {name!r}: delete it there, or choose another place"
                )
            copied, there = copied + is_new, there + (not is_new)
            say(f"{number} of {len(names)}: dataset {name} {'copied' if is_new else 'is there already'}")
    return CopiedDatasets(copied, there)
