"""Objects of a bucket as files of this host: fetched on demand, the least recently used removed within a bound.

files/NAME          a whole object; whoever uses it holds a shared lock on it, and locked files are not removed
files/.NAME.part    as large as the object that is being fetched, so that other processes leave it the room
fetching/NAME       locked by the one who fetches the object
room                locked while room is made, and while an object gets its name
.copy-…             links to the objects of a folder, as long as somebody uses them

Several processes of a host share the folder; a process that dies leaves nothing locked.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import threading
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from ultragray.files import TEMPORARY_SUFFIX, file_sha256, link_or_copy, remove_stale_temporaries
from ultragray_workers.claims import claimed_folder, remove_abandoned, try_lock
from ultragray_workers.errors import StorageFull
from ultragray_workers.storage.storage import Damaged, NotThere, Storage

KEEP_S = 10.0  # that a file stays after its last use, for whoever was told of it
DEFAULT_MAX_BYTES = 20 * 2**30  # of the files of data sets
_FILES, _FETCHING, _ROOM, _PART, _COPY = "files", "fetching", "room", ".part", ".copy-"
_WAIT_FOR_ROOM_S, _LOOK_EVERY_S = 30.0, 0.1
_AT_ONCE = 8  # objects of a folder


@dataclass
class CacheCounts:
    """What a process has asked of its cache since it began."""

    hits: int = 0
    misses: int = 0
    fetched_bytes: int = 0
    fetch_s: float = 0.0


class Pin:
    """A file of the cache, which stays until the pin is let go, or the body is left."""

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        self.path, self._file = path, file

    def let_go(self) -> None:
        self._file.close()

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *exception: object) -> None:
        self.let_go()


class Cache:
    """A folder of at most `max_bytes` of fetched objects. Its methods may be called from any thread, and block."""

    def __init__(self, folder: Path, max_bytes: int, keep_s: float = KEEP_S) -> None:
        self.folder, self.max_bytes, self._keep_s = folder, max_bytes, keep_s
        self._files, self._fetching = folder / _FILES, folder / _FETCHING
        self._counting = threading.Lock()
        self.counts = CacheCounts()

    def pin(self, storage: Storage, key: str, version: str, sha256: str | None = None) -> Pin:
        """The file of an object, fetched where it is not here; who asks meanwhile waits for the same fetch.

        `sha256`: of the content, which is checked, and under which the object is kept whatever its key and version.
        Raises NotThere where the object has gone or changed, Damaged, StorageUnavailable, StorageFull where the object
        has no room, OSError of the folder.
        """
        name = cache_name(storage, key, version, sha256)
        if (pin := self.held(name)) is not None:
            return pin
        began = time.monotonic()
        with self._alone_fetching(name):
            if (pin := self.held(name)) is None:
                pin, size = self._fetch(name, storage, key, version, sha256)
                with self._counting:
                    self.counts.misses += 1
                    self.counts.fetched_bytes += size
                    self.counts.fetch_s += time.monotonic() - began
            return pin

    @contextlib.contextmanager
    def copies(self, storage: Storage, prefix: str, sha256: Mapping[str, str]) -> Iterator[Path]:
        """A folder with objects below `prefix`, which stay during the body. Raises as `pin`.

        `sha256`: of each, by its path below the prefix. Those that do not fit the cache are fetched and not kept.
        """

        def place(path: str) -> None:
            key, target = f"{prefix}/{path}", content / path
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                with self.pin(storage, key, "", sha256[path]) as file:
                    link_or_copy(file, target)
            except StorageFull:
                storage.download(key, target)
                _check(target, path, sha256[path])
            except Damaged:
                raise Damaged(path) from None

        remove_abandoned(self.folder, _COPY)
        with claimed_folder(self.folder, _COPY) as folder:
            content = folder / "content"
            content.mkdir()
            with ThreadPoolExecutor(_AT_ONCE, "fetch") as threads:
                list(threads.map(place, sha256))
            yield content

    def held(self, name: str, *, counts: bool = True) -> Pin | None:
        """The file of an object (see `cache_name`) if it is here, which may count as a hit."""
        path = self._files / name
        while True:
            try:
                file = path.open("rb")
            except FileNotFoundError:
                return None
            fcntl.flock(file, fcntl.LOCK_SH)
            if _is_at(file, path):  # else it was removed before it was locked
                os.utime(file.fileno(), ns=(time.time_ns(), os.fstat(file.fileno()).st_mtime_ns))  # used last
                with self._counting:
                    self.counts.hits += counts
                return Pin(path, file)
            file.close()

    def held_bytes(self) -> int:
        with self._room():
            return sum(size for _, size, _ in self._entries())

    def _fetch(self, name: str, storage: Storage, key: str, version: str, sha256: str | None) -> tuple[Pin, int]:
        entry = storage.entry(key)
        if entry is None or (sha256 is None and entry.version != version):
            raise NotThere(f"there is no {key} of the version {version} in {storage.location}")
        self._files.mkdir(parents=True, exist_ok=True)
        part = self._part(name)
        try:
            self._reserve(part, entry.bytes)
            storage.download(key, part, version=entry.version)
            if sha256 is not None:
                _check(part, f"{key} in {storage.location}", sha256)
            file = part.open("rb")
            fcntl.flock(file, fcntl.LOCK_SH)  # before others can see it
            with self._room():  # else one who makes room could count the file twice
                part.rename(self._files / name)
            return Pin(self._files / name, file), entry.bytes
        finally:
            part.unlink(missing_ok=True)

    def _reserve(self, part: Path, needed: int) -> None:
        if needed > self.max_bytes:
            raise StorageFull(
                f"an object of {needed} bytes does not fit the cache of {self.max_bytes}: raise max_cache_bytes",
                field="max_cache_bytes",
            )
        end = time.monotonic() + _WAIT_FOR_ROOM_S
        while not self._try_to_reserve(part, needed):
            if time.monotonic() > end:
                raise StorageFull(
                    f"all of the cache of {self.max_bytes} bytes is in use, {needed} more are needed: raise "
                    "max_cache_bytes",
                    field="max_cache_bytes",
                )
            time.sleep(_LOOK_EVERY_S)

    def _try_to_reserve(self, part: Path, needed: int) -> bool:
        with self._room():
            entries = sorted(self._entries())
            free_bytes = self.max_bytes - sum(size for _, size, _ in entries)
            for used_at_s, size, path in entries:
                if free_bytes < needed and self._remove(path, used_at_s):
                    free_bytes += size
            if free_bytes < needed:
                return False
            with part.open("wb") as file:
                file.truncate(needed)
            return True

    def _entries(self) -> Iterator[tuple[float, int, Path]]:
        """When each object was used last, its bytes, and its file."""
        for path in self._files.glob("*"):
            if not path.name.endswith(TEMPORARY_SUFFIX):  # of a download, which counts by its part
                with contextlib.suppress(FileNotFoundError):
                    status = path.stat()
                    yield status.st_atime, status.st_size, path

    @contextlib.contextmanager
    def _room(self) -> Iterator[None]:
        """Nobody else reserves room, removes objects or names them during the body."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / _ROOM).open("a") as room:
            fcntl.flock(room, fcntl.LOCK_EX)
            yield

    def _remove(self, path: Path, used_at_s: float) -> bool:
        """Removes a file that nobody uses, or what a fetch has left whose process has died."""
        if path.name.endswith(_PART):
            name = path.name[1:].removesuffix(_PART)
            with self._lock_of_fetch(name) as lock:
                if not try_lock(lock):
                    return False
                remove_stale_temporaries(path)
                path.unlink(missing_ok=True)
                (self._fetching / name).unlink(missing_ok=True)
                return True
        if time.time() - used_at_s < self._keep_s:
            return False
        with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
            if not try_lock(file):
                return False
            path.unlink()
        return True

    @contextlib.contextmanager
    def _alone_fetching(self, name: str) -> Iterator[None]:
        path = self._fetching / name
        while True:
            with self._lock_of_fetch(name) as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                if not _is_at(lock, path):
                    continue  # the one before has removed it
                try:
                    yield
                finally:
                    path.unlink(missing_ok=True)
                return

    def _part(self, name: str) -> Path:
        return self._files / f".{name}{_PART}"

    def _lock_of_fetch(self, name: str) -> IO[bytes]:
        self._fetching.mkdir(parents=True, exist_ok=True)
        return (self._fetching / name).open("ab")


def cache_name(storage: Storage, key: str, version: str, sha256: str | None) -> str:
    """The name under which a cache keeps an object: by its content where that is known, with the suffix of its key."""
    content = sha256 or "v-" + hashlib.sha256(f"{storage.location}\n{key}\n{version}".encode()).hexdigest()
    return content + PurePosixPath(key).suffix


def _check(file: Path, name: str, sha256: str) -> None:
    if (digest := file_sha256(file)) != sha256:
        raise Damaged(f"{name} is damaged: its SHA-256 is {digest}")


def _is_at(file: IO[bytes], path: Path) -> bool:
    """Whether the open file still is the one of a path, which others may remove at any moment."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
