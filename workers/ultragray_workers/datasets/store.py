"""The data sets of an installation: the one in a folder of files, what a data set says of itself, and which there are.

An upload arrives and is checked in `datasets.intake`, and becomes a data set here, of objects of a storage:

datasets/NAME.json             the manifest, with the files of the data set: there is one as long as there is this
dataset-files/UPLOAD/PATH      the files of one upload, there before its manifest and gone after it

A data set appears and goes whole, by one conditional write of its manifest. One that is still open is a recording, see
`datasets.recording`, and has its name already. Free of torch.
"""

from __future__ import annotations

import contextlib
import json
import re
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from ultragray.contract import Contract, described, from_dict, to_dict
from ultragray.datasets.source import UPLOADED_FORMATS, load_dataset, options_of
from ultragray.errors import DatasetInvalid, InvalidArgument, UltragrayError
from ultragray.files import file_sha256, require_version, write_whole
from ultragray.geometry.probe import Probe
from ultragray.learn.sweep import ImageRegion
from ultragray_workers.datasets.recording import BLOCKS, Recordings
from ultragray_workers.errors import DatasetExists, DatasetInUse, DatasetNotFound, StorageUnavailable, known_names
from ultragray_workers.storage.cache import DEFAULT_MAX_BYTES
from ultragray_workers.storage.local import LocalStorage
from ultragray_workers.storage.location import open_storage
from ultragray_workers.storage.storage import Damaged, Entry, NotThere, Storage

if TYPE_CHECKING:
    from ultragray.datasets import Dataset


UPLOADS = "uploads"  # of the artifact folder
MANIFEST_NAME, FILES_NAME, CONTACT_SHEET_NAME = "dataset.json", "files", "contact_sheet.png"  # in a folder
MANIFESTS, FILES = "datasets", "dataset-files"  # prefixes of keys
FORMAT_VERSION = 1  # of the manifest
_NOT_KEPT = ("owner", "private")  # in the manifest: they are the database's
_STORED = "stored"  # key of the manifest
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")
_AT_ONCE = 8  # files
_LISTED_FOR_S = 1.0  # after which a data set that was listed is asked for again
_STRAY_AFTER_S = 86_400.0  # longer than any upload may take


@dataclass(frozen=True)
class DatasetRecord(Contract):
    """An accepted dataset."""

    name: str = described("Of letters, digits, '.', '_' and '-'.")
    kind: str = described(
        f"Its format: {'; '.join(f'{one.name}, {one.meaning}' for one in UPLOADED_FORMATS)}.",
        choices=tuple(one.name for one in UPLOADED_FORMATS),
    )
    sha256: str = described("Of images, poses, probe and split, however they were sent.")
    bytes: int = described("Of its files.")
    created_at: str = described("ISO 8601, UTC.")
    train_frames: int = described("Number of frames to train from.")
    val_frames: int = described("Number of frames held out.")
    height: int = described("Of a frame, pixels.")
    width: int = described("Of a frame, pixels.")
    probe: Probe | None = described("The probe that recorded it.")
    warnings: tuple[str, ...] = described("What looks wrong, for a person to decide.")
    options: dict[str, str] = described("How it was read: the query parameters of its upload.")
    region: ImageRegion | None = described(
        "Of a sequence: where its frames lie in the stored images, and its calibration; null where that is not known.",
        None,
    )
    owner: str | None = described("Who uploaded it; null: nobody who is known.", None)
    private: bool = described("Whether others may not see it.", False)

    @classmethod
    def from_json(cls, text: str) -> DatasetRecord:
        """The record of a manifest. Raises ValueError, KeyError or TypeError for anything else."""
        document: dict[str, Any] = json.loads(text)
        require_version(document["format_version"], FORMAT_VERSION)
        return from_dict(cls, {one.name: document[one.name] for one in fields(cls) if one.name not in _NOT_KEPT})


@dataclass(frozen=True)
class StoredFiles:
    """The files of an upload, by their path in the folder of the data set."""

    upload: str
    sha256: dict[str, str]

    @property
    def prefix(self) -> str:
        return f"{FILES}/{self.upload}"

    @classmethod
    def of(cls, manifest: str) -> StoredFiles:
        """The files that a manifest names. Raises DatasetInvalid."""
        try:
            files = cls(**json.loads(manifest)[_STORED])
        except (ValueError, KeyError, TypeError):
            raise DatasetInvalid("the manifest of the dataset does not name the files of the dataset") from None
        if any(PurePosixPath(path).is_absolute() or ".." in PurePosixPath(path).parts for path in files.sha256):
            raise DatasetInvalid("the manifest of the dataset names files outside of the dataset")
        return files


class DatasetStore:
    """The data sets that several services and workers share. Methods block, and raise StorageUnavailable."""

    def __init__(
        self,
        artifact_folder: Path,
        storage: Storage | None = None,
        max_copies_bytes: int = DEFAULT_MAX_BYTES,
        *,
        hides: Callable[[str], bool] = lambda name: False,
    ) -> None:
        """`storage`: where the data sets lie; None: in the artifact folder.

        `max_copies_bytes`: of this host's copies, where the storage is elsewhere, beside those in use. `hides`: whether
        a data set is hidden from whoever asks, who does not find it then.
        """
        self.folder = Path(artifact_folder) / UPLOADS  # in which uploads to this host arrive
        self.storage = storage or LocalStorage(Path(artifact_folder))
        self.recordings = Recordings(self.storage)
        self.hides = hides
        self._max_copies_bytes = max_copies_bytes
        self._known: dict[str, tuple[str, str]] = {}  # version and manifest, by name
        self._listed: dict[str, Entry] = {}
        self._listed_at_s = float("-inf")
        self._knowing = threading.Lock()

    def names(self) -> list[str]:
        """The names of all data sets, sorted."""
        paths = ((PurePosixPath(entry.key), entry) for entry in self.storage.entries_in(MANIFESTS))
        entries = {path.stem: entry for path, entry in paths if path.suffix == ".json" and _NAME.fullmatch(path.stem)}
        with self._knowing:
            self._listed, self._listed_at_s = entries, time.monotonic()
        return sorted(entries)

    def shown_names(self) -> list[str]:
        return [name for name in self.names() if not self.hides(name)]

    def names_by_content(self) -> dict[str, str]:
        """The name of a data set by its SHA-256; those whose manifest is damaged are left out."""
        names: dict[str, str] = {}
        for name in self.names():
            with contextlib.suppress(UltragrayError):
                names.setdefault(self.get(name).sha256, name)
        return names

    def get(self, name: str) -> DatasetRecord:
        """Raises DatasetNotFound, also for a name that no data set can have; DatasetInvalid for a damaged manifest."""
        self._require_shown(name)
        return self._read(name)

    def bytes_of(self, name: str) -> int:
        """The size of a data set, or of a recording that becomes one. Raises DatasetNotFound, DatasetInvalid."""
        return self.recordings.state(name).bytes if self.recordings.is_open(name) else self.get(name).bytes

    def load(self, name: str) -> Dataset:
        """Read a data set as it was when it was accepted. Raises DatasetNotFound, DatasetInvalid."""
        record = self.get(name)
        with self.files(name) as folder:
            return replace(load_dataset(folder / FILES_NAME, options_of(record.options)), name=name)

    def contact_sheet(self, name: str) -> bytes:
        self._require_shown(name)
        try:
            return self.storage.read(f"{self._files_of(name).prefix}/{CONTACT_SHEET_NAME}")
        except NotThere:
            raise self._not_found(name) from None

    def is_taken(self, name: str) -> bool:
        """Whether there is a data set of that name, or a recording that becomes one, hidden or not."""
        return self.manifest(name) is not None or self.recordings.is_open(name)

    def require(self, name: str) -> None:
        """Raises DatasetNotFound unless there is a data set of that name, or a recording that becomes one."""
        self._require_shown(name)
        if not self.is_taken(name):
            raise self._not_found(name)

    def manifest(self, name: str) -> str | None:
        """The manifest of a data set; None where there is none of that name."""
        with self._knowing:
            entry = self._listed.get(name) if time.monotonic() - self._listed_at_s < _LISTED_FOR_S else None
        entry = entry or self.storage.entry(_key(name))
        if entry is None:
            return None
        version, manifest = self._known.get(name, ("", ""))
        if version != entry.version:
            try:
                manifest = self.storage.read(entry.key).decode("utf-8")
            except NotThere:
                return None
            self._known[name] = entry.version, manifest
        return manifest

    @contextlib.contextmanager
    def files(self, name: str) -> Iterator[Path]:
        """A folder of this host with all of a data set but its manifest; it stays during the body.

        Raises DatasetNotFound, DatasetInvalid for a file that was changed.
        """
        stored = self._files_of(name)
        with contextlib.ExitStack() as stack:
            copy = self.storage.held(stored.prefix, stored.sha256, self.folder, self._max_copies_bytes)
            try:
                folder = stack.enter_context(copy)
            except NotThere:
                raise self._not_found(name) from None
            except Damaged as damaged:
                raise DatasetInvalid(
                    f"the file {damaged} of the dataset is not what was uploaded: it was changed in the storage"
                ) from None
            yield folder

    def add(self, folder: Path, name: str) -> tuple[DatasetRecord, bool]:
        """Makes a complete folder the data set `name`, at once; its record, and whether it is new.

        Where there is one already, it stays: with the same content and options it is the answer, else
        DatasetExists is raised.
        """
        manifest = (folder / MANIFEST_NAME).read_text(encoding="utf-8")
        if self.put(folder, manifest, name):
            return DatasetRecord.from_json(manifest), True
        return self.present(folder, name), False

    def present(self, folder: Path, name: str) -> DatasetRecord:
        """The data set `name`, where it is the one in a complete folder. Raises DatasetExists for another."""
        record = DatasetRecord.from_json((folder / MANIFEST_NAME).read_text(encoding="utf-8"))
        return self.held(name, record.sha256, record.options)

    def held(self, name: str, sha256: str | None, options: dict[str, str]) -> DatasetRecord:
        """The data set `name`, where it has that content and those options. Raises DatasetExists for another."""
        if self.recordings.is_open(name):
            raise DatasetExists(f"the name {name!r} is that of a recording: choose another one", field="dataset")
        record = self._read(name)
        if (record.sha256, record.options) == (sha256, options) and not self.hides(name):
            return record
        raise DatasetExists(
            f"there is already a dataset {name!r} with another content or other options: delete it first, or choose "
            "another name",
            field="dataset",
        )

    def put(self, folder: Path, manifest: str, name: str) -> bool:
        """Makes the files of a folder, with a manifest, the data set `name`; False where there is one already."""
        files = [path for path in folder.rglob("*") if path.is_file() and path != folder / MANIFEST_NAME]
        paths = {path.relative_to(folder).as_posix(): path for path in sorted(files)}
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

    def delete(self, name: str, in_use: Callable[[str], str | None] = lambda name: None) -> None:
        """Raises DatasetNotFound, and DatasetInUse where `in_use` names in words who needs it.

        `in_use` is asked again when nobody finds the data set any more: who came in between gets it back, unless
        another one has taken its name.
        """
        self._require_shown(name)
        if (manifest := self.manifest(name)) is None:
            raise self._not_found(name)
        _require_unused(name, in_use)
        self.storage.delete(_key(name))
        with self._knowing:
            self._listed_at_s = float("-inf")
        try:
            _require_unused(name, in_use)
        except BaseException:
            if not self.storage.write(_key(name), manifest.encode(), if_absent=True):
                self._remove_files(StoredFiles.of(manifest))
            raise
        with contextlib.suppress(DatasetInvalid):
            self._remove_files(StoredFiles.of(manifest))

    def remove_stray_files(self) -> int:
        """Removes the files of uploads and recordings that nothing names and that are a day old; how many there were.

        Those of a recording that has become a data set are gone with it, unless its service died in between.
        """
        return self._remove_strays(FILES, self._uploads) + self._remove_strays(BLOCKS, self.recordings.ids)

    def _uploads(self) -> set[str]:
        uploads = set()
        for name in self.names():
            with contextlib.suppress(DatasetInvalid, DatasetNotFound):
                uploads.add(self._files_of(name).upload)
        return uploads

    def _remove_strays(self, prefix: str, known_uploads: Callable[[], set[str]]) -> int:
        old: dict[str, list[Entry]] = {}
        for entry in self.storage.entries(prefix):
            if time.time() - entry.modified > _STRAY_AFTER_S:
                old.setdefault(entry.key.split("/")[1], []).append(entry)
        known = known_uploads() if old else set()
        strays = {upload: entries for upload, entries in old.items() if upload not in known}
        for upload in strays:
            self.storage.delete_all(f"{prefix}/{upload}")
        return sum(map(len, strays.values()))

    def _read(self, name: str) -> DatasetRecord:
        if (manifest := self.manifest(name)) is None:
            raise self._not_found(name)
        try:
            return DatasetRecord.from_json(manifest)
        except (ValueError, KeyError, TypeError) as error:
            reason = f"it has no {error}" if isinstance(error, KeyError) else error
            raise DatasetInvalid(f"the manifest of the dataset {name!r} cannot be used: {reason}") from error

    def _files_of(self, name: str) -> StoredFiles:
        if (manifest := self.manifest(name)) is None:
            raise self._not_found(name)
        return StoredFiles.of(manifest)

    def _remove_files(self, stored: StoredFiles) -> None:
        """Removes the files of an upload; those that a storage that is away keeps go as strays."""
        with contextlib.suppress(StorageUnavailable):
            self.storage.delete_all(stored.prefix)

    def _require_shown(self, name: str) -> None:
        if not _NAME.fullmatch(name) or self.hides(name):
            raise self._not_found(name)

    def _not_found(self, name: str) -> DatasetNotFound:
        return DatasetNotFound(
            f"there is no dataset {name[:128]!r}; {known_names('dataset', self.shown_names())}", field="dataset"
        )


def without_files(manifest: str) -> dict[str, Any]:
    return {key: value for key, value in json.loads(manifest).items() if key != _STORED}


def _key(name: str) -> str:
    return f"{MANIFESTS}/{name}.json"


def check_dataset_name(name: str) -> None:
    """Raises InvalidArgument for a name that no dataset may have."""
    if not _NAME.fullmatch(name):
        raise InvalidArgument(
            f"dataset must be 1 to 128 letters, digits, '.', '_', '-', the first a letter or digit, got {name[:128]!r}",
            field="dataset",
        )


def write_manifest(record: DatasetRecord, folder: Path) -> None:
    values = {name: value for name, value in to_dict(record).items() if name not in _NOT_KEPT}
    document = {"format_version": FORMAT_VERSION, **values}
    write_whole(folder / MANIFEST_NAME, json.dumps(document, indent=1) + "\n")


def _require_unused(name: str, in_use: Callable[[str], str | None]) -> None:
    if (user := in_use(name)) is not None:
        raise DatasetInUse(f"the dataset {name!r} is needed by {user}", field="dataset")


def open_datasets(
    artifact_folder: str | Path, storage: str | None, max_copies_bytes: int = DEFAULT_MAX_BYTES
) -> DatasetStore:
    return DatasetStore(Path(artifact_folder), None if storage is None else open_storage(storage), max_copies_bytes)
