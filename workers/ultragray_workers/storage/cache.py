"""Objects of a bucket as files of this host: fetched on demand, the least recently used removed within a bound.

files/NAME          a whole object; whoever uses it holds a shared lock on it, and locked files are not removed
files/NAME.space    as large as the object that is being fetched, so that other processes leave it the room
fetching/NAME       locked by the one who fetches the object
room                locked while room is made

Several processes of a host share the folder; a process that dies leaves nothing locked.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from ultragray.files import file_sha256, remove_stale_temporaries
from ultragray_workers.errors import StorageFull, StorageUnavailable
from ultragray_workers.storage.storage import NotThere, Storage

_FILES, _FETCHING, _ROOM, _SPACE = "files", "fetching", "room", ".space"
_WAIT_FOR_ROOM_S, _LOOK_EVERY_S = 30.0, 0.1


@dataclass(frozen=True)
class CacheCounts:
    """What a process has asked of its cache since it began."""

    hits: int = 0
    misses: int = 0
    fetched_bytes: int = 0
    fetch_s: float = 0.0


class Pin:
    """A file of the cache, which stays until the pin is let go."""

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        self.path, self._file = path, file

    def let_go(self) -> None:
        """From now on the file may be removed."""
        self._file.close()


class Cache:
    """A folder of at most `max_bytes` of fetched objects. Its methods may be called from any thread, and block."""

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self.folder, self.max_bytes = folder, max_bytes
        self._files, self._fetching = folder / _FILES, folder / _FETCHING
        self._counting = threading.Lock()
        self._counts = CacheCounts()

    @property
    def counts(self) -> CacheCounts:
        with self._counting:
            return self._counts

    @contextlib.contextmanager
    def file(self, storage: Storage, key: str, version: str, sha256: str | None = None) -> Iterator[Path]:
        """The file of an object during the body. Raises as `pin`."""
        pin = self.pin(storage, key, version, sha256)
        try:
            yield pin.path
        finally:
            pin.let_go()

    def pin(self, storage: Storage, key: str, version: str, sha256: str | None = None) -> Pin:
        """The file of an object, fetched where it is not here; who asks meanwhile waits for the same fetch.

        `sha256`: of the content, which is checked, and under which the object is kept whatever its key and version.
        Raises NotThere where the object has gone or changed, StorageUnavailable, StorageFull where the object has no
        room, OSError of the folder.
        """
        name = cache_name(storage, key, version, sha256)
        if (pin := self.held(name)) is not None:
            self._count(hits=1)
            return pin
        began = time.monotonic()
        with self._alone_fetching(name):
            pin = self.held(name)
            if pin is None:
                pin, size = self._fetch(name, storage, key, version, sha256)
                self._count(misses=1, fetched_bytes=size, fetch_s=time.monotonic() - began)
            else:
                self._count(hits=1)
            return pin

    def held(self, name: str) -> Pin | None:
        """The file of an object (see `cache_name`) if it is here."""
        path = self._files / name
        while True:
            try:
                file = path.open("rb")
            except FileNotFoundError:
                return None
            fcntl.flock(file, fcntl.LOCK_SH)
            if _is_at(file, path):  # else it was removed before it was locked
                os.utime(file.fileno(), ns=(time.time_ns(), os.fstat(file.fileno()).st_mtime_ns))  # used last
                return Pin(path, file)
            file.close()

    def count_hit(self) -> None:
        """Counts a use of a file that was pinned before."""
        self._count(hits=1)

    def held_bytes(self) -> int:
        """Of the objects that are here or being fetched."""
        with self._room():
            return sum(size for _, size, _ in self._held())

    def _fetch(self, name: str, storage: Storage, key: str, version: str, sha256: str | None) -> tuple[Pin, int]:
        entry = storage.entry(key)
        if entry is None or (sha256 is None and entry.version != version):
            raise NotThere(f"there is no {key} of the version {version} in {storage.location}")
        self._files.mkdir(parents=True, exist_ok=True)
        space, part = self._files / f"{name}{_SPACE}", self._part(name)
        try:
            self._reserve(space, entry.bytes)
            storage.download(key, part, version=entry.version)
            if sha256 is not None and (got := file_sha256(part)) != sha256:
                raise StorageUnavailable(f"{key} in {storage.location} is damaged: its SHA-256 is {got}")
            file = part.open("rb")
            fcntl.flock(file, fcntl.LOCK_SH)  # before others can see it
            with self._room():  # else one who makes room could see neither the space nor the file
                part.rename(self._files / name)
                space.unlink()
            return Pin(self._files / name, file), entry.bytes
        finally:
            part.unlink(missing_ok=True)
            space.unlink(missing_ok=True)

    def _reserve(self, space: Path, needed: int) -> None:
        if needed > self.max_bytes:
            raise StorageFull(
                f"an object of {needed} bytes does not fit the cache of {self.max_bytes}: raise max_cache_bytes",
                field="max_cache_bytes",
            )
        end = time.monotonic() + _WAIT_FOR_ROOM_S
        while not self._try_to_reserve(space, needed):
            if time.monotonic() > end:
                raise StorageFull(
                    f"all of the cache of {self.max_bytes} bytes is in use, {needed} more are needed: raise "
                    "max_cache_bytes",
                    field="max_cache_bytes",
                )
            time.sleep(_LOOK_EVERY_S)

    def _try_to_reserve(self, space: Path, needed: int) -> bool:
        with self._room():
            held = sorted(self._held())
            left = self.max_bytes - sum(size for _, size, _ in held)
            for _, size, path in held:
                if left >= needed:
                    break
                if self._remove(path):
                    left += size
            if left < needed:
                return False
            with space.open("wb") as file:
                file.truncate(needed)
            return True

    def _held(self) -> Iterator[tuple[float, int, Path]]:
        """When each object was used last, its bytes, and its file."""
        names = {path.name for path in self._files.glob("[!.]*")}  # what is being fetched counts by the space it has
        for name in names:
            if name.removesuffix(_SPACE) == name or name.removesuffix(_SPACE) not in names:  # fetched a moment ago
                with contextlib.suppress(FileNotFoundError):
                    status = (self._files / name).stat()
                    yield status.st_atime, status.st_size, self._files / name

    @contextlib.contextmanager
    def _room(self) -> Iterator[None]:
        """Nobody else reserves room or removes objects during the body."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / _ROOM).open("a") as room:
            fcntl.flock(room, fcntl.LOCK_EX)
            yield

    def _remove(self, path: Path) -> bool:
        """Removes a file that nobody uses, or the space of a fetch whose process has died."""
        name = path.name.removesuffix(_SPACE)
        if name != path.name:
            with self._lock_of_fetch(name) as lock:
                if not _try_lock(lock):
                    return False
                part = self._part(name)
                part.unlink(missing_ok=True)
                remove_stale_temporaries(part)
                path.unlink(missing_ok=True)
                (self._fetching / name).unlink(missing_ok=True)
                return True
        try:
            with path.open("rb") as file:
                if not _try_lock(file):
                    return False
                path.unlink()
                return True
        except FileNotFoundError:
            return True

    @contextlib.contextmanager
    def _alone_fetching(self, name: str) -> Iterator[None]:
        while True:
            with self._lock_of_fetch(name) as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                path = self._fetching / name
                if not _is_at(lock, path):
                    continue  # the one before has removed it
                try:
                    yield
                finally:
                    path.unlink(missing_ok=True)
                return

    def _part(self, name: str) -> Path:
        return self._files / f".{name}.part"

    def _lock_of_fetch(self, name: str) -> IO[bytes]:
        self._fetching.mkdir(parents=True, exist_ok=True)
        return (self._fetching / name).open("ab")

    def _count(self, hits: int = 0, misses: int = 0, fetched_bytes: int = 0, fetch_s: float = 0.0) -> None:
        with self._counting:
            was = self._counts
            self._counts = CacheCounts(
                was.hits + hits, was.misses + misses, was.fetched_bytes + fetched_bytes, was.fetch_s + fetch_s
            )


def cache_name(storage: Storage, key: str, version: str, sha256: str | None) -> str:
    """The name under which a cache keeps an object: by its content where that is known, with the suffix of its key."""
    content = sha256 or "v-" + hashlib.sha256(f"{storage.location}\n{key}\n{version}".encode()).hexdigest()
    return content + PurePosixPath(key).suffix


def _is_at(file: IO[bytes], path: Path) -> bool:
    """Whether the open file still is the one of a path, which others may remove at any moment."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _try_lock(file: IO[bytes]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
