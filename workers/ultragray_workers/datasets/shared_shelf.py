"""Datasets in a storage that several hosts share, each fetched whole to a host that needs it. Free of torch.

datasets/NAME/dataset.json     the manifest, with the files of the dataset: there is a dataset as long as there is this
dataset-files/UPLOAD/PATH      the files of one upload, there before its manifest and gone after it
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
from pathlib import Path
from typing import Any

from ultragray.errors import DatasetInvalid
from ultragray.files import file_sha256
from ultragray_workers.claims import is_claimed
from ultragray_workers.datasets.copies import DEFAULT_MAX_BYTES, LocalCopies
from ultragray_workers.datasets.shelf import CONTACT_SHEET_NAME, FILES_NAME, MANIFEST_NAME
from ultragray_workers.errors import DatasetNotFound, StorageUnavailable
from ultragray_workers.shared_claims import SharedClaims
from ultragray_workers.storage.storage import Entry, NotThere, Storage

MANIFESTS, FILES = "datasets", "dataset-files"  # prefixes of keys
_AT_ONCE = 8  # files
_LISTED_FOR_S = 1.0  # after which a dataset that was listed is asked for again
_STRAY_AFTER_S = 86_400.0  # longer than any upload may take
_SHARED = "shared"  # key of the manifest


@dataclass(frozen=True)
class SharedFiles:
    """The files of an upload, by their path in the folder of the dataset."""

    upload: str
    sha256: dict[str, str]

    def key(self, path: str) -> str:
        """The key of a file."""
        return f"{FILES}/{self.upload}/{path}"

    @classmethod
    def of(cls, manifest: str) -> SharedFiles:
        """Those that a manifest names. Raises DatasetInvalid."""
        try:
            return cls(**json.loads(manifest)[_SHARED])
        except (ValueError, KeyError, TypeError):
            raise DatasetInvalid("the manifest of the dataset does not name the files of the dataset") from None


def without_shared_files(document: dict[str, Any]) -> dict[str, Any]:
    """A manifest as it is in a folder."""
    return {key: value for key, value in document.items() if key != _SHARED}


class SharedShelf:
    """The datasets of a storage, with copies on this host of those that were used last."""

    def __init__(self, storage: Storage, folder: Path, max_copies_bytes: int = DEFAULT_MAX_BYTES) -> None:
        """`folder`: of this host, for the copies, which take at most `max_copies_bytes` beside those in use."""
        self._storage = storage
        self._folder = folder
        self._copies = LocalCopies(folder, max_copies_bytes)
        self._claims = SharedClaims(storage)
        self._known: dict[str, tuple[str, str]] = {}  # version and manifest, by name
        self._listed: dict[str, Entry] = {}
        self._listed_at_s = float("-inf")
        self._knowing = threading.Lock()

    def names(self) -> list[str]:
        """As `Shelf`."""
        entries = self._entries()
        with self._knowing:
            self._listed, self._listed_at_s = entries, time.monotonic()
        return list(entries)

    def manifest(self, name: str) -> str | None:
        """As `Shelf`."""
        with self._knowing:
            entry = self._listed.get(name) if time.monotonic() - self._listed_at_s < _LISTED_FOR_S else None
        entry = entry or self._storage.entry(_manifest_key(name))
        if entry is None:
            return None
        with self._knowing:
            version, manifest = self._known.get(name, ("", ""))
        if version == entry.version:
            return manifest
        try:
            manifest = self._storage.read(entry.key).decode("utf-8")
        except NotThere:
            return None
        with self._knowing:
            self._known[name] = entry.version, manifest
        return manifest

    def contact_sheet(self, name: str) -> Path:
        """As `Shelf`; the copy may go when other datasets are fetched."""
        shared = self._files_of(name)
        with self._copies.held(
            f"{shared.upload}-sheet", lambda folder: self._fetch(shared, folder, CONTACT_SHEET_NAME)
        ) as folder:
            return folder / CONTACT_SHEET_NAME

    @contextlib.contextmanager
    def files(self, name: str) -> Iterator[Path]:
        """As `Shelf`, fetched whole where this host has no copy."""
        shared = self._files_of(name)
        with self._copies.held(shared.upload, lambda folder: self._fetch(shared, folder, *shared.sha256)) as folder:
            yield folder / FILES_NAME

    def put(self, folder: Path, name: str) -> bool:
        """As `Shelf`, by one conditional write after the files are there."""
        files = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / MANIFEST_NAME)
        paths = {path.relative_to(folder).as_posix(): path for path in files}
        shared = SharedFiles(secrets.token_hex(16), {name: file_sha256(path) for name, path in paths.items()})
        document: dict[str, Any] = json.loads((folder / MANIFEST_NAME).read_text(encoding="utf-8"))
        is_ours = False
        try:
            with ThreadPoolExecutor(_AT_ONCE, "dataset-upload") as threads:
                list(threads.map(lambda path: self._storage.upload(paths[path], shared.key(path)), paths))
            manifest = json.dumps({**document, _SHARED: asdict(shared)}, indent=1) + "\n"
            is_ours = self._storage.write(_manifest_key(name), manifest.encode(), if_absent=True)
        finally:
            if not is_ours:
                self._remove_files(shared)
        return is_ours

    @contextlib.contextmanager
    def without(self, name: str) -> Iterator[bool]:
        """As `Shelf`."""
        manifest = self.manifest(name)
        if manifest is None:
            yield False
            return
        key = _manifest_key(name)
        self._storage.delete(key)
        with self._knowing:
            self._listed_at_s = float("-inf")
        try:
            yield True
        except BaseException:
            if not self._storage.write(key, manifest.encode(), if_absent=True):
                self._remove_files(SharedFiles.of(manifest))
            raise
        with contextlib.suppress(DatasetInvalid):
            self._remove_files(SharedFiles.of(manifest))

    def is_claimed(self, token: str) -> bool:
        """As `Shelf`."""
        return is_claimed(self._folder / token) or self._claims.is_claimed(token)

    def claimed(self, token: str) -> contextlib.AbstractContextManager[None]:
        """As `Shelf`."""
        return self._claims.claimed(token)

    def remove_stray_files(self) -> int:
        """Removes the files of uploads that no manifest names and that are a day old; how many there were."""
        old: dict[str, list[Entry]] = {}
        for entry in self._storage.entries(FILES):
            if time.time() - entry.modified > _STRAY_AFTER_S:
                old.setdefault(entry.key.split("/")[1], []).append(entry)
        named = set()
        for name in self.names() if old else ():
            with contextlib.suppress(DatasetInvalid, DatasetNotFound):
                named.add(self._files_of(name).upload)
        strays = [entry for upload, entries in old.items() if upload not in named for entry in entries]
        for entry in strays:
            self._storage.delete(entry.key)
        return len(strays)

    def _files_of(self, name: str) -> SharedFiles:
        manifest = self.manifest(name)
        if manifest is None:
            raise DatasetNotFound(f"there is no dataset {name!r} any more", field="dataset")
        return SharedFiles.of(manifest)

    def _entries(self) -> dict[str, Entry]:
        found = (entry for entry in self._storage.entries(MANIFESTS))
        parts = ((entry.key.split("/"), entry) for entry in found)
        return {key[1]: entry for key, entry in parts if len(key) == 3 and key[2] == MANIFEST_NAME}

    def _fetch(self, shared: SharedFiles, folder: Path, *paths: str) -> None:
        """Copies files of an upload into a folder, and checks them. Raises DatasetNotFound where one is gone."""

        def fetch(path: str) -> None:
            copy = folder / path
            copy.parent.mkdir(parents=True, exist_ok=True)
            try:
                self._storage.download(shared.key(path), copy)
            except NotThere:
                raise DatasetNotFound("the dataset has been deleted", field="dataset") from None
            if file_sha256(copy) != shared.sha256[path]:
                raise DatasetInvalid(
                    f"the file {path} of the dataset is not what was uploaded: it was changed in the storage"
                )

        if any(Path(path).is_absolute() or ".." in Path(path).parts for path in paths):
            raise DatasetInvalid("the manifest of the dataset names files outside of the dataset")
        with ThreadPoolExecutor(_AT_ONCE, "dataset-fetch") as threads:
            list(threads.map(fetch, paths))

    def _remove_files(self, shared: SharedFiles) -> None:
        """Removes the files of an upload; those that a storage that is away keeps go as strays."""
        with contextlib.suppress(StorageUnavailable):
            for path in shared.sha256:
                self._storage.delete(shared.key(path))


def _manifest_key(name: str) -> str:
    return f"{MANIFESTS}/{name}/{MANIFEST_NAME}"
