"""The datasets of a running service, and the archive that an upload sends."""

from __future__ import annotations

import contextlib
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from ultragray.datasets.source import UPLOADED_FORMATS
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray_service.remote.connection import Connection, Count, route

ARCHIVE_SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz")


class Datasets:
    """Asks for datasets over a connection, and raises as it does."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def all(self) -> list[dict[str, Any]]:
        """Every dataset, by name."""
        return self._connection.listed("/v1/datasets", "datasets")

    def get(self, name: str) -> dict[str, Any]:
        """One dataset."""
        found: dict[str, Any] = self._connection.json("GET", route("datasets", name))
        return found

    def delete(self, name: str) -> None:
        """Delete a dataset that no job needs."""
        self._connection.json("DELETE", route("datasets", name))

    def upload(
        self, name: str, archive: Path, options: dict[str, str], count: Count, *, private: bool
    ) -> tuple[dict[str, Any], bool]:
        """The dataset that an archive holds, once the service has checked it, and whether it is new there."""
        query = urlencode({**options, **({"private": "true"} if private else {})})
        return self._connection.upload(route("datasets", name, suffix=f"?{query}" if query else ""), archive, count)


@contextlib.contextmanager
def archive_of(source: Path, device_set: Path | None = None) -> Iterator[Path]:
    """An archive of what a source is: itself, or a zip of the folder or of the sequence with the files that it needs.

    `device_set` goes into the archive too. Raises DatasetInvalid where there is no such source or it is none, and
    InvalidArgument for a device set beside an archive.
    """
    if source.name.lower().endswith(ARCHIVE_SUFFIXES) and source.is_file():
        if device_set is not None:
            raise InvalidArgument(f"--device-set must be in the archive {source}", field="device_set")
        yield source
        return
    files = _files_of(source) + ([] if device_set is None else [device_set])
    with tempfile.TemporaryDirectory(prefix="ultragray-upload-") as folder:
        archive = Path(folder, "upload.zip")
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=1, strict_timestamps=False) as made:
            for path in files:
                below = source if source.is_dir() else source.parent
                name = path.relative_to(below) if path.is_relative_to(below) else Path(path.name)
                made.write(path, name.as_posix())
        yield archive


def _files_of(source: Path) -> list[Path]:
    if source.is_dir():
        files = sorted(path for path in source.rglob("*") if path.is_file() and not _is_hidden(path, source))
        if not any(one.is_file(path) for one in UPLOADED_FORMATS for path in files):
            expected = "; ".join(one.meaning for one in UPLOADED_FORMATS)
            raise DatasetInvalid(f"{source}: no sweep lies in this folder; expected is one of: {expected}")
        return files
    if not source.is_file():
        raise DatasetInvalid(f"{source}: no such file or folder")
    if source.name == "conf.json":
        return _files_of(source.parent)
    format = next((one for one in UPLOADED_FORMATS if one.is_file(source)), None)
    if format is None:
        expected = "; ".join(one.meaning for one in UPLOADED_FORMATS)
        raise DatasetInvalid(f"{source}: an upload is an archive ({', '.join(ARCHIVE_SUFFIXES)}) or one of: {expected}")
    stems = {source.stem, source.name.split(".")[0]}  # of sweep.igs.mhd: sweep.igs and sweep
    beside = (source.with_name(f"{stem}{ending}") for stem in stems for ending in format.beside)
    return [source, *sorted(path for path in beside if path.is_file())]


def _is_hidden(path: Path, folder: Path) -> bool:
    """Whether a file, or a folder on the way to it, is hidden: no part of a sweep, such as .git."""
    return any(part.startswith(".") for part in path.relative_to(folder).parts)
