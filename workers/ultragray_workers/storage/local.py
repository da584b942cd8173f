"""A folder as a storage: its files are the objects, and stay where they are."""

from __future__ import annotations

import contextlib
import fcntl
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from ultragray.files import TEMPORARY_SUFFIX, link_or_copy, sync
from ultragray_workers.claims import remove_whole, try_lock
from ultragray_workers.storage.storage import Entry, NotThere, check_key

_CLAIMS = "claims"  # prefix of keys; a claim is locked as long as its process lives
_LOCK = ".storage.lock"  # held while an object gets its place, where there are no links


@dataclass(frozen=True)
class FileVersion:
    """Tells one content of a file from the next, without reading it."""

    mtime_ns: int
    size: int
    inode: int

    @property
    def tag(self) -> str:
        return f"{self.mtime_ns:x}-{self.size:x}-{self.inode:x}"

    @classmethod
    def of(cls, path: str | Path | int) -> FileVersion:
        """The version of a file, by its path or descriptor. Raises OSError."""
        return cls._of(os.stat(path))

    @classmethod
    def _of(cls, status: os.stat_result) -> FileVersion:
        return cls(mtime_ns=status.st_mtime_ns, size=status.st_size, inode=status.st_ino)


@lru_cache(maxsize=1024)
def _joined(folder: Path, key: str) -> Path:
    """The path of a key. Raises InvalidArgument for one that would leave the folder."""
    return folder / check_key(key)


class LocalStorage:
    """The files below a folder. The folder is made by the first write."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.location = str(folder)
        self.is_near = True

    def entries(self, prefix: str = "") -> Iterator[Entry]:
        for folder, _, names in os.walk(self._folder(prefix)):
            yield from self._entries_of(Path(folder), names)

    def entries_in(self, prefix: str = "") -> Iterator[Entry]:
        folder = self._folder(prefix)
        try:
            names = [item.name for item in os.scandir(folder) if item.is_file()]
        except (FileNotFoundError, NotADirectoryError):
            return
        yield from self._entries_of(folder, names)

    def _entries_of(self, folder: Path, names: Iterable[str]) -> Iterator[Entry]:
        for name in names:
            if name != _LOCK and not (name.startswith(".") and name.endswith(TEMPORARY_SUFFIX)):
                path = folder / name
                with contextlib.suppress(FileNotFoundError):  # gone meanwhile
                    yield self._entry(path.relative_to(self.folder).as_posix(), path.stat())

    def entry(self, key: str) -> Entry | None:
        path = self._path(key)
        try:
            return self._entry(key, path.stat()) if path.is_file() else None
        except (FileNotFoundError, NotADirectoryError):
            return None

    def read(self, key: str, *, start: int = 0, length: int | None = None) -> bytes:
        with self._open(key) as descriptor, open(descriptor, "rb", closefd=False) as file:
            file.seek(start)
            return file.read(-1 if length is None else length)

    def write(self, key: str, data: bytes, *, if_absent: bool = False) -> bool:
        def fill(file: Path) -> None:
            file.write_bytes(data)
            sync(file)

        return self._put(key, fill, if_absent) or self._path(key).read_bytes() == data

    def upload(self, path: Path, key: str, *, if_absent: bool = False) -> bool:
        if if_absent and self._path(key).exists():
            return False
        return self._put(key, lambda file: link_or_copy(path, file), if_absent)

    def _put(self, key: str, fill: Callable[[Path], object], if_absent: bool) -> bool:
        """Whether what `fill` writes is the object now; False: `if_absent`, and there is one."""
        path = self._path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        with self._whole(path) as file:
            fill(file)
            if not if_absent:
                file.replace(path)
            elif not self._place_new(file, path):
                return False
        sync(path.parent)
        return True

    def download(self, key: str, path: Path, *, version: str | None = None) -> Entry:
        with self._open(key, version) as descriptor, self._whole(path) as file:
            link_or_copy(self._path(key), file)
            file.replace(path)
            return self._entry(key, os.stat(descriptor))

    def delete(self, key: str) -> None:
        path = self._path(key)
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            path.unlink()
            sync(path.parent)

    def delete_all(self, prefix: str) -> None:
        remove_whole(self._folder(prefix))

    def delete_half_written(self, prefix: str) -> None:
        for path in self._folder(prefix).rglob(f".*{TEMPORARY_SUFFIX}"):
            path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def held(self, prefix: str, sha256: Mapping[str, str], folder: Path, max_bytes: int) -> Iterator[Path]:
        place = self._folder(prefix)
        if not place.is_dir():
            raise NotThere(f"there is no {prefix} in {self.location}")
        yield place

    @contextlib.contextmanager
    def claimed(self, token: str) -> Iterator[None]:
        path = self._path(f"{_CLAIMS}/{token}")
        path.parent.mkdir(parents=True, exist_ok=True)
        with self._whole(path) as file, file.open("wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            file.rename(path)  # nobody finds it unlocked
            try:
                yield
            finally:
                path.unlink(missing_ok=True)

    def is_claimed(self, token: str) -> bool:
        try:
            with self._path(f"{_CLAIMS}/{token}").open("rb+") as lock:
                if not try_lock(lock):
                    return True
        except (FileNotFoundError, NotADirectoryError):
            return False
        self.delete(f"{_CLAIMS}/{token}")  # of a process that died
        return False

    def free_bytes(self) -> int | None:
        return shutil.disk_usage(self.folder).free

    def in_place(self, key: str) -> Path | None:
        return self._path(key)

    def _folder(self, prefix: str) -> Path:
        return self.folder / check_key(prefix) if prefix else self.folder

    def _path(self, key: str) -> Path:
        return _joined(self.folder, key)

    @contextlib.contextmanager
    def _open(self, key: str, version: str | None = None) -> Iterator[int]:
        """The descriptor of a file, of the version asked for. Raises NotThere."""
        try:
            descriptor = os.open(self._path(key), os.O_RDONLY)
        except (FileNotFoundError, NotADirectoryError):
            raise NotThere(f"there is no {key} in {self.location}") from None
        try:
            if version is not None and FileVersion.of(descriptor).tag != version:
                raise NotThere(f"{key} in {self.location} is no longer of the version {version}")
            yield descriptor
        finally:
            os.close(descriptor)

    @contextlib.contextmanager
    def _whole(self, path: Path) -> Iterator[Path]:
        """A path beside `path` on which nothing is yet; what is there at the end is removed."""
        temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}{TEMPORARY_SUFFIX}")
        try:
            yield temporary
        finally:
            temporary.unlink(missing_ok=True)

    def _place_new(self, file: Path, path: Path) -> bool:
        """Gives a whole file its place, unless there is one already."""
        try:
            os.link(file, path)
        except FileExistsError:
            return False
        except OSError:  # a file system without links
            with (self.folder / _LOCK).open("a") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                if path.exists():
                    return False
                file.replace(path)
        return True

    @staticmethod
    def _entry(key: str, status: os.stat_result) -> Entry:
        return Entry(key, status.st_size, FileVersion._of(status).tag, status.st_mtime)
