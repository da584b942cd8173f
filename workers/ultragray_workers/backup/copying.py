"""Copies of the scenes and datasets of an installation into another storage, such as from a folder into a bucket.

The keys are the same below both, so that a service that is started with the other location serves the same.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ultragray.files import file_sha256
from ultragray_workers.datasets.store import DatasetStore, without_files
from ultragray_workers.errors import RestoreRefused, StorageUnavailable
from ultragray_workers.storage.storage import NotThere, Storage

ARTIFACTS = "artifacts"  # the artifact folder, below a data folder
_SCENES = re.compile(
    rf"({ARTIFACTS}/)?(scenes/(objects/)?)?[A-Za-z0-9][A-Za-z0-9._-]*\.ug[rz]|({ARTIFACTS}/)?scenes/[^./][^/]*\.json"
)


@dataclass(frozen=True)
class Copied:
    scenes: int = 0
    bytes: int = 0
    already_there: int = 0


def copy_scenes(source: Storage, target: Storage, say: Callable[[str], None] = lambda sentence: None) -> Copied:
    """Copies the scenes of `source` that `target` has not, and compares each with its copy by SHA-256.

    Interrupted, the same call goes on: what is there already is compared, not copied. Names come after the files that
    they name. Raises RestoreRefused where the target has other content under a key, StorageUnavailable, OSError.
    """
    keys = sorted((entry.key for entry in source.entries() if _SCENES.fullmatch(entry.key)), key=_names_last)
    copied = bytes_ = there = 0
    for number, key in enumerate(keys, 1):
        with _file(source, key) as file:
            sha256 = file_sha256(file)
            is_new = target.entry(key) is None and target.upload(file, key, if_absent=True)
            with _file(target, key) as copy:
                digest = file_sha256(copy)
            if digest != sha256 and is_new:
                raise StorageUnavailable(f"the copy of {key} in {target.location} has another SHA-256: copy again")
            if digest != sha256:
                raise RestoreRefused(f"{target.location} has another {key}: remove it there, or choose another place")
            copied, there = copied + is_new, there + (not is_new)
            bytes_ += file.stat().st_size if is_new else 0
        say(f"{number} of {len(keys)}: {key} {'copied' if is_new else 'is there already'}")
    return Copied(copied, bytes_, there)


def _names_last(key: str) -> tuple[bool, str]:
    return key.endswith(".json"), key


@contextmanager
def _file(storage: Storage, key: str) -> Iterator[Path]:
    if (path := storage.in_place(key)) is not None:
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="ultragray-copy-") as folder:
        path = Path(folder, "object")
        try:
            storage.download(key, path)
        except NotThere as error:
            raise StorageUnavailable(str(error)) from None
        yield path


@dataclass(frozen=True)
class CopiedDatasets:
    datasets: int = 0
    datasets_already_there: int = 0


def copy_datasets(
    source: Storage, target: Storage, say: Callable[[str], None] = lambda sentence: None
) -> CopiedDatasets:
    """Copies the datasets that the target has not, each whole or not at all.

    Interrupted, the same call goes on with those that are missing. Raises RestoreRefused where the target has another
    dataset of a name, StorageUnavailable, OSError.
    """
    copied = kept = 0
    with tempfile.TemporaryDirectory(prefix="ultragray-copy-") as copies:
        here, there = DatasetStore(Path(copies, "from"), source), DatasetStore(Path(copies, "to"), target)
        names = here.names()
        for number, name in enumerate(names, 1):
            manifest = here.manifest(name)
            if manifest is None:  # deleted meanwhile
                continue
            with here.files(name) as folder:
                is_new = there.manifest(name) is None and there.put(folder, manifest, name)
            copy = there.manifest(name)
            if not is_new and (copy is None or without_files(copy) != without_files(manifest)):
                raise RestoreRefused(
                    f"{target.location} has another dataset {name!r}: delete it there, or choose another place"
                )
            copied, kept = copied + is_new, kept + (not is_new)
            say(f"{number} of {len(names)}: dataset {name} {'copied' if is_new else 'is there already'}")
    return CopiedDatasets(copied, kept)
