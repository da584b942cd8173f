"""The datasets of an installation: the one in a folder of files, what a dataset says of itself, and which there are."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ultragray.contract import Contract, described, from_dict, to_dict
from ultragray.datasets.source import UPLOADED_FORMATS, DatasetFormat, SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid, InvalidArgument, UltragrayError
from ultragray.files import require_version, write_whole
from ultragray.geometry.probe import Probe
from ultragray.learn.sweep import ImageRegion
from ultragray_workers.datasets.shelf import MANIFEST_NAME, DatasetShelf
from ultragray_workers.errors import DatasetExists, DatasetInUse, DatasetNotFound, known_names
from ultragray_workers.storage.copies import DEFAULT_MAX_BYTES
from ultragray_workers.storage.local import LocalStorage
from ultragray_workers.storage.location import open_storage
from ultragray_workers.storage.storage import Storage

if TYPE_CHECKING:
    from ultragray.datasets import Dataset


_NAMES_IN_MESSAGE = 5


@dataclass(frozen=True)
class UploadedSource:
    """The file by which the dataset is known, and the files that are options of it."""

    format: DatasetFormat
    path: Path
    companions: dict[str, Path]  # by the name of the option

    def load(self, options: dict[str, str]) -> Dataset:
        """Read the dataset. Raises as `load_dataset`."""
        given: dict[str, Any] = {**options, **self.companions}
        return load_dataset(self.path, SourceOptions(**given))


def find_source(files: Path) -> UploadedSource:
    """The dataset below a folder. Raises DatasetInvalid, naming files from that folder, where there is not one."""
    relative = sorted(path.relative_to(files) for path in files.rglob("*") if path.is_file())
    plain = [path for path in relative if not any(part.startswith((".", "__MACOSX")) for part in path.parts)]
    sources = [(one, path) for one in UPLOADED_FORMATS for path in plain if one.is_file(path)]
    if not sources:
        expected = " or ".join(one.upload_meaning for one in UPLOADED_FORMATS)
        raise DatasetInvalid(f"the upload must hold {expected}, it holds {_listed(plain) or 'no files'}")
    if len(sources) > 1:
        raise DatasetInvalid(f"the upload must hold one dataset, it holds {_listed([path for _, path in sources])}")
    ((found, source),) = sources
    companions = {}
    for option, pattern in found.companions.items():
        matching = [path for path in plain if fnmatchcase(path.name.lower(), pattern)]
        if len(matching) > 1:
            raise DatasetInvalid(f"the upload must hold at most one {option} ({pattern}), it holds {_listed(matching)}")
        if matching:
            companions[option] = files / matching[0]
    return UploadedSource(found, files / source, companions)


def _listed(paths: list[Path]) -> str:
    shown = ", ".join(map(str, paths[:_NAMES_IN_MESSAGE]))
    return shown + (f" and {len(paths) - _NAMES_IN_MESSAGE} more" if len(paths) > _NAMES_IN_MESSAGE else "")


# The datasets of an installation: what a dataset says of itself, and which there are. Free of torch.
#
# An upload arrives in `datasets.incoming`, is checked by `datasets.intake`, and becomes a dataset here; where its
# files lie is known to `datasets.shelf`.


UPLOADS = "uploads"  # of the artifact folder
FORMAT_VERSION = 1  # of the manifest
_NOT_KEPT = ("owner", "private")  # in the manifest: they are the database's
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")


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


class DatasetStore:
    """The datasets that several services and workers share."""

    def __init__(
        self,
        artifact_folder: Path,
        storage: Storage | None = None,
        max_copies_bytes: int = DEFAULT_MAX_BYTES,
        *,
        hides: Callable[[str], bool] = lambda name: False,
    ) -> None:
        """`storage`: where the datasets lie; None: in the artifact folder.

        `max_copies_bytes`: of this host's copies, where the storage is elsewhere, beside those in use. `hides`: whether
        a dataset is hidden from whoever asks, who does not find it then.
        """
        self.folder = Path(artifact_folder) / UPLOADS  # in which uploads to this host arrive
        self.shelf = DatasetShelf(storage or LocalStorage(Path(artifact_folder)), self.folder, max_copies_bytes)
        self.hides = hides

    def names(self) -> list[str]:
        """The names of all datasets, sorted."""
        return sorted(name for name in self.shelf.names() if _NAME.fullmatch(name))

    def shown_names(self) -> list[str]:
        """As `names`, without those that are hidden."""
        return [name for name in self.names() if not self.hides(name)]

    def get(self, name: str) -> DatasetRecord:
        """Raises DatasetNotFound, also for a name that no dataset can have; DatasetInvalid for a damaged manifest."""
        if not self._is_shown(name):
            raise self._not_found(name)
        return self._read(name)

    def _read(self, name: str) -> DatasetRecord:
        manifest = self.shelf.manifest(name)
        if manifest is None:
            raise self._not_found(name)
        try:
            return DatasetRecord.from_json(manifest)
        except (ValueError, KeyError, TypeError) as error:
            reason = f"it has no {error}" if isinstance(error, KeyError) else error
            raise DatasetInvalid(f"the manifest of the dataset {name!r} cannot be used: {reason}") from error

    def names_by_content(self) -> dict[str, str]:
        """The name of a dataset by its SHA-256; those whose manifest is damaged are left out."""
        found: dict[str, str] = {}
        for name in self.names():
            with contextlib.suppress(UltragrayError):
                found.setdefault(self.get(name).sha256, name)
        return found

    def load(self, name: str) -> Dataset:
        """Read a dataset as it was when it was accepted. Raises DatasetNotFound, DatasetInvalid."""
        record = self.get(name)
        with self.shelf.files(name) as files:
            return replace(find_source(files).load(record.options), name=name)

    def contact_sheet(self, name: str) -> bytes:
        """The PNG. Raises DatasetNotFound."""
        self._require_existing(name)
        return self.shelf.contact_sheet(name)

    def add(self, folder: Path, name: str) -> tuple[DatasetRecord, bool]:
        """Makes a complete folder the dataset `name`, at once; its record, and whether it is new.

        Where there is one already, it stays: with the same content and options it is the answer, else
        DatasetExists is raised.
        """
        manifest = (folder / MANIFEST_NAME).read_text(encoding="utf-8")
        record = DatasetRecord.from_json(manifest)
        if self.shelf.put(folder, manifest, name):
            return record, True
        return self.present(folder, name), False

    def present(self, folder: Path, name: str) -> DatasetRecord:
        """The dataset `name`, where it is the one in a complete folder. Raises DatasetExists for another."""
        record = DatasetRecord.from_json((folder / MANIFEST_NAME).read_text(encoding="utf-8"))
        present = self._read(name)
        if (present.sha256, present.options) == (record.sha256, record.options) and not self.hides(name):
            return present
        raise DatasetExists(
            f"there is already a dataset {name!r} with another content or other options: delete it first, or choose "
            "another name",
            field="dataset",
        )

    def delete(self, name: str, in_use: Callable[[str], str | None] = lambda name: None) -> None:
        """Raises DatasetNotFound, and DatasetInUse where `in_use` names in words who needs it.

        `in_use` is asked again when nobody finds the dataset any more: who came in between gets it back, unless
        another one has taken its name.
        """
        self._require_existing(name)
        _require_unused(name, in_use)
        with self.shelf.without(name) as found:
            if not found:
                raise self._not_found(name)
            _require_unused(name, in_use)

    def _require_existing(self, name: str) -> None:
        if not (self._is_shown(name) and self.is_taken(name)):
            raise self._not_found(name)

    def _is_shown(self, name: str) -> bool:
        return _NAME.fullmatch(name) is not None and not self.hides(name)

    def is_taken(self, name: str) -> bool:
        """Whether there is a dataset of that name, hidden or not."""
        return self.shelf.manifest(name) is not None

    def _not_found(self, name: str) -> DatasetNotFound:
        return DatasetNotFound(
            f"there is no dataset {name[:128]!r}; {known_names('dataset', self.shown_names())}", field="dataset"
        )


def check_dataset_name(name: str) -> None:
    """Raises InvalidArgument for a name that no dataset may have."""
    if not _NAME.fullmatch(name):
        raise InvalidArgument(
            f"dataset must be 1 to 128 letters, digits, '.', '_', '-', the first a letter or digit, got {name[:128]!r}",
            field="dataset",
        )


def write_manifest(record: DatasetRecord, folder: Path) -> None:
    """Writes the manifest of a dataset whose other files are complete."""
    kept = {name: value for name, value in to_dict(record).items() if name not in _NOT_KEPT}
    document = {"format_version": FORMAT_VERSION, **kept}
    write_whole(folder / MANIFEST_NAME, json.dumps(document, indent=1) + "\n")


def _require_unused(name: str, in_use: Callable[[str], str | None]) -> None:
    if (user := in_use(name)) is not None:
        raise DatasetInUse(f"the dataset {name!r} is needed by {user}", field="dataset")


def open_datasets(
    artifact_folder: str | Path, storage: str | None, max_copies_bytes: int = DEFAULT_MAX_BYTES
) -> DatasetStore:
    """The datasets at a location that a process is told in words; None: in the artifact folder."""
    return DatasetStore(Path(artifact_folder), None if storage is None else open_storage(storage), max_copies_bytes)
