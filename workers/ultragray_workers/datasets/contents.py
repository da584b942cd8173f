"""The one dataset in a folder of files that somebody sent. Free of torch."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ultragray.datasets.source import UPLOADED_FORMATS, DatasetFormat, SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid

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
