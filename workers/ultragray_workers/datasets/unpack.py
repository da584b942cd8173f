"""Archives from strangers: only plain files, only below the folder, never more than a limit. Free of torch."""

from __future__ import annotations

import errno
import gzip
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path, PurePosixPath
from typing import IO, TypeVar

from ultragray.errors import DatasetInvalid
from ultragray.files import sync
from ultragray_workers.errors import UploadTooLarge

MAX_FILES = 1000
MAX_ENTRIES = 10_000  # of an archive, folders included
MAX_PATH_LENGTH, MAX_PART_LENGTH = 512, 200
_BLOCK_BYTES = 1 << 20
_GZIP_MAGIC = b"\x1f\x8b"
_ZIP_MAGIC = b"PK\x03\x04"

_Entry = TypeVar("_Entry")


class FileBudget:
    """Counts the files and bytes of a dataset while they are written."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._bytes_left = max_bytes
        self._files_left = MAX_FILES

    def take_file(self) -> None:
        self._files_left -= 1
        if self._files_left < 0:
            raise UploadTooLarge(f"a dataset may have at most {MAX_FILES} files")

    def take_bytes(self, count: int) -> None:
        self._bytes_left -= count
        if self._bytes_left < 0:
            raise UploadTooLarge(
                f"a dataset may have at most {self._max_bytes} bytes, packed and unpacked (ULTRAGRAY_MAX_DATASET_BYTES)"
            )


def create_below(folder: Path, name: str) -> IO[bytes]:
    """Opens a new file at the relative path `name` below `folder`, whose folders are made.

    Raises DatasetInvalid for a path that leaves the folder, is not plain text, or is taken.
    """
    parts = [part for part in PurePosixPath(name).parts if part != "."]
    if (
        not parts
        or name.startswith("/")
        or ".." in parts
        or "\\" in name
        or not name.isprintable()
        or len(name.encode()) > MAX_PATH_LENGTH
        or any(len(part.encode()) > MAX_PART_LENGTH for part in parts)
    ):
        raise DatasetInvalid(f"file names must be plain paths within the dataset, got {name[:200]!a}")
    path = folder.joinpath(*parts)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("xb")
    except (FileExistsError, NotADirectoryError):
        raise DatasetInvalid(f"the file {name!r} comes twice") from None


def unpack(archive: Path, folder: Path, max_bytes: int) -> None:
    """Unpacks a .zip, .tar or .tar.gz.

    Raises DatasetInvalid for a damaged archive and for entries that are no plain files within the folder;
    UploadTooLarge as soon as more comes out than `max_bytes`.
    """
    budget = FileBudget(max_bytes)
    try:
        with archive.open("rb") as file:
            beginning = file.read(len(_ZIP_MAGIC))
        packed = beginning.startswith(_GZIP_MAGIC)
        if packed or tarfile.is_tarfile(archive):
            _unpack_tar(archive, "r:gz" if packed else "r:", folder, budget)
        elif zipfile.is_zipfile(archive):
            _unpack_zip(archive, folder, budget)
        elif beginning == _ZIP_MAGIC:
            raise DatasetInvalid("the .zip is cut short: its end is missing")
        else:
            raise DatasetInvalid("the archive is neither .zip nor .tar nor .tar.gz")
    except (
        zipfile.BadZipFile,
        tarfile.TarError,
        gzip.BadGzipFile,
        zlib.error,
        EOFError,
        NotImplementedError,
        UnicodeError,
    ) as error:
        raise _damaged(error) from error
    except OSError as error:
        if error.errno != errno.EINVAL:  # of a seek to where the archive's directory says that a file begins
            raise
        raise _damaged(error) from error


def _unpack_zip(archive: Path, folder: Path, budget: FileBudget) -> None:
    with zipfile.ZipFile(archive) as zip_file:
        for entry in _counted(iter(zip_file.infolist())):
            kind = stat.S_IFMT(entry.external_attr >> 16)
            if entry.is_dir():
                continue
            if kind not in (0, stat.S_IFREG):
                raise _not_plain(entry.filename)
            if entry.flag_bits & 1:
                raise DatasetInvalid(f"the archive is encrypted: {entry.filename[:200]!a}")
            _copy(entry.filename, zip_file.open(entry), folder, budget)


def _unpack_tar(archive: Path, mode: str, folder: Path, budget: FileBudget) -> None:
    with tarfile.open(archive, mode) as tar_file:  # type: ignore[call-overload]  # mypy wants a literal
        for entry in _counted(iter(tar_file)):
            if entry.isdir():
                continue
            content = tar_file.extractfile(entry) if entry.isreg() else None
            if content is None:
                raise _not_plain(entry.name)
            _copy(entry.name, content, folder, budget)


def _counted(entries: Iterator[_Entry]) -> Iterator[_Entry]:
    for number, entry in enumerate(entries):
        if number >= MAX_ENTRIES:
            raise UploadTooLarge(f"an archive may have at most {MAX_ENTRIES} entries")
        yield entry


def _copy(name: str, content: AbstractContextManager[IO[bytes]], folder: Path, budget: FileBudget) -> None:
    budget.take_file()
    with content as source, create_below(folder, name) as target:
        while block := source.read(_BLOCK_BYTES):
            budget.take_bytes(len(block))
            target.write(block)
    sync(Path(target.name))


def _damaged(error: Exception) -> DatasetInvalid:
    return DatasetInvalid(f"the archive is damaged, or of a kind that cannot be read: {error}")


def _not_plain(name: str) -> DatasetInvalid:
    return DatasetInvalid(f"an archive may hold plain files only, no links and no devices: {name[:200]!a}")
