"""Datasets as objects of a storage: by name, each a manifest, the files that were sent, and a contact sheet.

datasets/NAME.json             the manifest, with the files of the dataset: there is a dataset as long as there is this
dataset-files/UPLOAD/PATH      the files of one upload, there before its manifest and gone after it

A dataset appears and goes whole, by one conditional write of its manifest. `datasets.store` knows what a manifest says.
Free of torch.
"""

from __future__ import annotations

import contextlib
import json
import secrets
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from ultragray.errors import DatasetInvalid
from ultragray.files import file_sha256
from ultragray_workers.errors import DatasetNotFound, StorageUnavailable
from ultragray_workers.storage.copies import DEFAULT_MAX_BYTES
from ultragray_workers.storage.storage import Damaged, Entry, NotThere, Storage

MANIFEST_NAME, FILES_NAME, CONTACT_SHEET_NAME = "dataset.json", "files", "contact_sheet.png"  # in a folder
MANIFESTS, FILES = "datasets", "dataset-files"  # prefixes of keys
_SUFFIX = ".json"
_AT_ONCE = 8  # files
_LISTED_FOR_S = 1.0  # after which a dataset that was listed is asked for again
_STRAY_AFTER_S = 86_400.0  # longer than any upload may take
_STORED = "stored"  # key of the manifest


@dataclass(frozen=True)
class StoredFiles:
    """The files of an upload, by their path in the folder of the dataset."""

    upload: str
    sha256: dict[str, str]

    @property
    def prefix(self) -> str:
        """The prefix of their keys."""
        return f"{FILES}/{self.upload}"

    @classmethod
    def of(cls, manifest: str) -> StoredFiles:
        """Those that a manifest names. Raises DatasetInvalid."""
        try:
            found = cls(**json.loads(manifest)[_STORED])
        except (ValueError, KeyError, TypeError):
            raise DatasetInvalid("the manifest of the dataset does not name the files of the dataset") from None
        if any(PurePosixPath(path).is_absolute() or ".." in PurePosixPath(path).parts for path in found.sha256):
            raise DatasetInvalid("the manifest of the dataset names files outside of the dataset")
        return found


class DatasetShelf:
    """The datasets of a storage. Methods block, and raise StorageUnavailable."""

    def __init__(self, storage: Storage, folder: Path, max_copies_bytes: int = DEFAULT_MAX_BYTES) -> None:
        """`folder`: of this host, for copies where there must be some, of at most `max_copies_bytes` beside those in
        use.
        """
        self.storage = storage
        self._folder, self._max_copies_bytes = folder, max_copies_bytes
        self._known: dict[str, tuple[str, str]] = {}  # version and manifest, by name
        self._listed: dict[str, Entry] = {}
        self._listed_at_s = float("-inf")
        self._knowing = threading.Lock()

    def names(self) -> list[str]:
        """The names of all datasets."""
        found = ((entry.key.rpartition("/")[2], entry) for entry in self.storage.entries_in(MANIFESTS))
        entries = {file.removesuffix(_SUFFIX): entry for file, entry in found if file.endswith(_SUFFIX)}
        with self._knowing:
            self._listed, self._listed_at_s = entries, time.monotonic()
        return list(entries)

    def manifest(self, name: str) -> str | None:
        """The manifest of a dataset; None where there is none of that name."""
        with self._knowing:
            entry = self._listed.get(name) if time.monotonic() - self._listed_at_s < _LISTED_FOR_S else None
        entry = entry or self.storage.entry(_key(name))
        if entry is None:
            return None
        with self._knowing:
            version, manifest = self._known.get(name, ("", ""))
        if version == entry.version:
            return manifest
        try:
            manifest = self.storage.read(entry.key).decode("utf-8")
        except NotThere:
            return None
        with self._knowing:
            self._known[name] = entry.version, manifest
        return manifest

    def contact_sheet(self, name: str) -> bytes:
        """The PNG of a dataset. Raises DatasetNotFound."""
        try:
            return self.storage.read(f"{self._files_of(name).prefix}/{CONTACT_SHEET_NAME}")
        except NotThere:
            raise _gone(name) from None

    @contextlib.contextmanager
    def files(self, name: str) -> Iterator[Path]:
        """The folder of a dataset's files on this host; it stays during the body. Raises DatasetNotFound."""
        with self.folder(name) as folder:
            yield folder / FILES_NAME

    @contextlib.contextmanager
    def folder(self, name: str) -> Iterator[Path]:
        """All of a dataset but its manifest. Raises DatasetNotFound, DatasetInvalid for a file that was changed."""
        stored = self._files_of(name)
        with contextlib.ExitStack() as stack:
            held = self.storage.held(stored.prefix, stored.sha256, self._folder, self._max_copies_bytes)
            try:
                folder = stack.enter_context(held)
            except NotThere:
                raise _gone(name) from None
            except Damaged as damaged:
                raise DatasetInvalid(
                    f"the file {damaged} of the dataset is not what was uploaded: it was changed in the storage"
                ) from None
            yield folder

    def put(self, folder: Path, manifest: str, name: str) -> bool:
        """Makes the files of a folder, with a manifest, the dataset `name`; False where there is one already."""
        files = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / MANIFEST_NAME)
        paths = {path.relative_to(folder).as_posix(): path for path in files}
        stored = StoredFiles(secrets.token_hex(16), {name: file_sha256(path) for name, path in paths.items()})
        document = {**without_files(manifest), _STORED: asdict(stored)}
        is_ours = False
        try:
            with ThreadPoolExecutor(_AT_ONCE, "dataset-upload") as threads:
                list(threads.map(lambda path: self.storage.upload(paths[path], f"{stored.prefix}/{path}"), paths))
            is_ours = self.storage.write(_key(name), (json.dumps(document, indent=1) + "\n").encode(), if_absent=True)
        finally:
            if not is_ours:
                self._remove_files(stored)
        return is_ours

    @contextlib.contextmanager
    def without(self, name: str) -> Iterator[bool]:
        """Nobody finds the dataset during the body; then it is removed, or put back where the body raises.

        Gives whether it was there. Where its name was taken meanwhile, it is not put back.
        """
        manifest = self.manifest(name)
        if manifest is None:
            yield False
            return
        self.storage.delete(_key(name))
        with self._knowing:
            self._listed_at_s = float("-inf")
        try:
            yield True
        except BaseException:
            if not self.storage.write(_key(name), manifest.encode(), if_absent=True):
                self._remove_files(StoredFiles.of(manifest))
            raise
        with contextlib.suppress(DatasetInvalid):
            self._remove_files(StoredFiles.of(manifest))

    def remove_stray_files(self) -> int:
        """Removes the files of uploads that no manifest names and that are a day old; how many there were."""
        old: dict[str, list[Entry]] = {}
        for entry in self.storage.entries(FILES):
            if time.time() - entry.modified > _STRAY_AFTER_S:
                old.setdefault(entry.key.split("/")[1], []).append(entry)
        named = set()
        for name in self.names() if old else ():
            with contextlib.suppress(DatasetInvalid, DatasetNotFound):
                named.add(self._files_of(name).upload)
        strays = {upload: entries for upload, entries in old.items() if upload not in named}
        for upload in strays:
            self.storage.delete_all(f"{FILES}/{upload}")
        return sum(map(len, strays.values()))

    def _files_of(self, name: str) -> StoredFiles:
        if (manifest := self.manifest(name)) is None:
            raise _gone(name)
        return StoredFiles.of(manifest)

    def _remove_files(self, stored: StoredFiles) -> None:
        """Removes the files of an upload; those that a storage that is away keeps go as strays."""
        with contextlib.suppress(StorageUnavailable):
            self.storage.delete_all(stored.prefix)


def without_files(manifest: str) -> dict[str, Any]:
    """What a manifest says beside where the files are."""
    return {key: value for key, value in json.loads(manifest).items() if key != _STORED}


def _gone(name: str) -> DatasetNotFound:
    return DatasetNotFound(f"there is no dataset {name!r} any more", field="dataset")


def _key(name: str) -> str:
    return f"{MANIFESTS}/{name}{_SUFFIX}"
