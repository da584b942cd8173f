"""The scenes of a storage, by name: where the file of each is, and how one is added, fetched and removed.

PREFIX/NAME.ugr              a scene as an operator copied it there, or in a folder as it was imported or made
PREFIX/NAME.ugz              likewise, where there is no NAME.ugr
PREFIX/NAME.json             a scene that was imported or made in a bucket: {"format_version", "sha256", "bytes", …}
PREFIX/objects/SHA256.ugr    the file of such scenes, which never changes

A name is given once: by a link where the storage is near, by a conditional write of NAME.json where it is not, since no
bucket takes a large file on a condition. A near storage is looked at on every question. Of a bucket the list is kept,
and read again every FRESH_S seconds; files are fetched into a cache of this host.
"""

from __future__ import annotations

import contextlib
import json
import logging
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Hashable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path, PurePosixPath
from typing import Any

from ultragray.errors import SceneFileInvalid
from ultragray.files import file_sha256
from ultragray.scene.info import (
    BESIDE,
    SceneHeader,
    SceneInfo,
    check_header_size,
    read_header,
    scene_file_invalid,
)
from ultragray_workers.claims import claimed_folder, remove_abandoned
from ultragray_workers.errors import SceneExists, StorageUnavailable
from ultragray_workers.rounds import Rounds
from ultragray_workers.scene_names import SUFFIX, SUFFIXES, is_scene_name
from ultragray_workers.storage.cache import Cache, Pin, cache_name
from ultragray_workers.storage.storage import Damaged, Entry, NotThere, Storage

SCENES_FOLDER = "scenes"  # prefix of the scenes that jobs made, or that were imported
OBJECTS, ENTRY_SUFFIX, MAKING_PREFIX = "objects", ".json", ".importing-"
FRESH_S = 2.0  # after which the list is read again by whoever follows it
_OLD_S = 2.5 * FRESH_S  # and by whoever asks
UNUSED_AFTER_S = 86_400.0  # objects that no name has had so long are removed
HOUSEKEEPING_S = 3600.0
_FORMAT_VERSION = 1
_READ_AT_ONCE = 8

_log = logging.getLogger("ultragray.scenes")


@dataclass(frozen=True)
class Placed:
    """Where the file of a scene is."""

    key: str
    version: str  # tells one content of the scene from the next
    bytes: int
    sha256: str | None  # None: of a scene that was copied there


class SceneShelf:
    """The scenes below a prefix. Methods may be called from any thread.

    All but `knows`, `here` and `hold` may block, and raise StorageUnavailable where a bucket does not answer.
    """

    def __init__(
        self,
        storage: Storage,
        prefix: str = "",
        *,
        cache: Cache | None = None,
        working_folder: Path | None = None,
        longest_stale_s: float = 0.0,
    ) -> None:
        """`cache` and `working_folder` (for scenes that are being made): of this host, where the storage is not near.

        `longest_stale_s`: how long what was found last counts where the bucket does not answer.
        """
        self.storage, self.is_near = storage, storage.is_near
        self._prefix, self._cache, self._longest_stale_s = prefix, cache, longest_stale_s
        within = storage.in_place(self._key(MAKING_PREFIX))
        self._working_folder = working_folder if within is None else within.parent
        self._known: dict[str, Placed] = {}
        self._read_at_s: float | None = None  # time.monotonic()
        self._tried_at_s = 0.0
        self._entries: dict[str, tuple[str, Placed | None]] = {}  # by name: the version of NAME.json, and what it says
        self._misnamed: set[str] = set()  # keys of scene files that are left out, and were told
        self._changes = 0  # by this process
        self._changing, self._reading = threading.Lock(), threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None  # that reads the list: others are not kept waiting for it
        self.problem: StorageUnavailable | None = None  # of the last reading
        self.unavailable_total = 0

    @property
    def age_s(self) -> float:
        """Since the list was read."""
        if self.is_near:
            return 0.0
        return float("inf") if self._read_at_s is None else time.monotonic() - self._read_at_s

    @property
    def is_usable(self) -> bool:
        """Whether scenes are served as they were found last."""
        return self.age_s <= self._longest_stale_s

    def follow(self) -> None:
        """Reads the list of the scenes of a bucket now, and every FRESH_S seconds in a thread of its own."""
        if self.is_near:
            return
        self._thread = threading.Thread(target=self._follow, name="scenes of a bucket", daemon=True)
        self._thread.start()
        self.read()

    def close(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    def names(self) -> set[str]:
        """All names; of a bucket as they are, or were at most `longest_stale_s` ago."""
        return set(self._scenes())

    def has(self, name: str) -> bool:
        """Whether there is the scene, also one that another service has just added."""
        return is_scene_name(name) and self._get(name) is not None

    def knows(self, name: str) -> bool:
        """The same as it was found last."""
        return is_scene_name(name) and (self._near_file(name) is not None or self._known_as(name) is not None)

    def here(self, name: str) -> Path | None:
        """The file of the scene on this host; None where it has to be fetched first, or there is none."""
        with self.hold(name, counts=False) or nullcontext() as path:
            return path

    def hold(self, name: str, *, counts: bool = True) -> AbstractContextManager[Path] | None:
        """The file of `here`, which stays until the context is left. It `counts` as a use of the cache."""
        if (path := self._near_file(name)) is not None:
            return nullcontext(path)
        if (placed := self._known_as(name)) is None:
            return None
        if (path := self.storage.in_place(placed.key)) is not None:
            return nullcontext(path)
        return self._cached(placed, counts=counts)

    def fetch(self, name: str) -> Path:
        """The file of the scene, on this host from now on. Raises FileNotFoundError, StorageFull."""
        placed = self._placed(name)
        if (path := self.storage.in_place(placed.key)) is not None:
            return path
        try:
            return self._fetched(placed)
        except NotThere:  # replaced or removed since the list was read
            self.read()
        try:
            return self._fetched(self._placed(name))
        except NotThere as error:
            raise StorageUnavailable(f"the scene {name!r} has no file: {error}") from None

    def version(self, name: str) -> str:
        """Tells one content of the scene from the next. Raises FileNotFoundError."""
        return self._placed(name).version

    def header(self, name: str) -> SceneHeader:
        """The description of the scene; its Gaussians are not fetched. Raises FileNotFoundError, SceneFileInvalid."""
        placed = self._placed(name)
        if (path := self.here(name)) is not None:
            return read_header(path)
        if self.problem is not None:
            raise self.problem
        try:
            return fetch_header(self.storage, placed.key, placed.bytes, f"{name}{SUFFIX}")
        except NotThere:
            raise FileNotFoundError(name) from None

    def bytes_of(self, name: str) -> int:
        """The size of a scene's file; 0 where there is none."""
        return 0 if (placed := self._get(name)) is None else placed.bytes

    def sha256(self, name: str) -> str | None:
        """The hash of the file, where it is known without reading it."""
        return None if (placed := self._get(name)) is None else placed.sha256

    def publish(self, file: Path, name: str) -> None:
        """Serves a file, which is not changed any more, as a scene; nothing where it is served already.

        Raises SceneExists where another scene has the name, OSError.
        """
        sha256 = file_sha256(file)
        if not (self._place(file, name, sha256) if self.is_near else self._name(file, name, sha256)):
            raise SceneExists(f"there is already a scene {name!r}", field="scene")

    def replace(self, file: Path, name: str) -> None:
        """Serves a file, which is not changed any more, in the place of the scene that has the name, at once.

        Whoever reads the scene has the one or the other whole. Raises OSError.
        """
        if self.is_near:
            there = self.look_up(name)
            self.storage.upload(file, self._key(f"{name}{SUFFIX}"))
            if there is not None and there.sha256 is not None:  # of a folder that was copied from a bucket
                self.storage.delete(self._entry_key(name))
            elif there is not None and there.key != self._key(f"{name}{SUFFIX}"):
                self.storage.delete(there.key)
        else:
            sha256, size = file_sha256(file), file.stat().st_size
            self._upload(file, self._object(sha256))
            self.storage.write(self._entry_key(name), _entry_text(sha256, size))
            self._change(name, Placed(self._object(sha256), sha256, size, sha256))

    def remove(self, name: str) -> bool:
        there = self.look_up(name)
        if there is not None:
            self.storage.delete(there.key if there.sha256 is None else self._entry_key(name))
        self._change(name, None)
        return there is not None

    @contextlib.contextmanager
    def making(self) -> Iterator[Path]:
        """A new folder in which a file is made, whose name is a token that tells other services who is at it."""
        assert self._working_folder is not None
        with claimed_folder(self._working_folder, MAKING_PREFIX) as folder, self.storage.claimed(folder.name):
            yield folder

    def is_making(self, token: str) -> bool:
        return self.storage.is_claimed(token)

    def remove_abandoned(self) -> None:
        """Removes the folders of `making` whose services died."""
        assert self._working_folder is not None
        remove_abandoned(self._working_folder, MAKING_PREFIX)

    def look_up(self, name: str) -> Placed | None:
        """One scene as it is now."""
        for suffix in SUFFIXES:
            if (copied := self.storage.entry(self._key(f"{name}{suffix}"))) is not None:
                return Placed(copied.key, copied.version, copied.bytes, None)
        return self._read_entry(self._entry_key(name))

    def read(self) -> None:
        """Reads the list of a bucket."""
        with self._reading:
            try:
                while not self._read():
                    pass
            except StorageUnavailable as error:
                self.problem = error
                self.unavailable_total += 1
                raise
            finally:
                self._tried_at_s = time.monotonic()
            self.problem = None

    def remove_unused(self, older_than_s: float = UNUSED_AFTER_S) -> int:
        """Removes the objects that no name has; how many there were."""
        before = time.time() - older_than_s
        old = [one for one in self.storage.entries_in(self._key(OBJECTS)) if one.modified < before]
        used = {placed.key for placed in self._scan().values()} if old else set()  # after the objects were listed
        removed = 0
        for one in old:
            now = None if one.key in used else self.storage.entry(one.key)
            if now is not None and now.modified < before:  # else somebody has just uploaded it again
                self.storage.delete(one.key)
                removed += 1
        return removed

    def _place(self, file: Path, name: str, sha256: str) -> bool:
        """Gives a file its name in a near storage; False where another content has it."""
        if self.look_up(name) is None and self.storage.upload(file, self._key(f"{name}{SUFFIX}"), if_absent=True):
            return True
        path = self.here(name)
        return path is not None and file_sha256(path) == sha256

    def _name(self, file: Path, name: str, sha256: str) -> bool:
        """Uploads a file to a bucket, and gives it its name; False where another content has it."""
        there, key, size = self.look_up(name), self._object(sha256), file.stat().st_size
        if there is None:
            self._upload(file, key)
            if not self.storage.write(self._entry_key(name), _entry_text(sha256, size), if_absent=True):
                there = self.look_up(name)
                if there is None:
                    return False
        if there is not None and there.sha256 != sha256:
            return False
        self._upload(file, key)  # again: removed as unused the very moment before it was named
        self._change(name, Placed(key, sha256, size, sha256))
        return True

    def _upload(self, file: Path, key: str) -> None:
        there = self.storage.entry(key)
        if there is None or time.time() - there.modified > UNUSED_AFTER_S / 2:  # else it might soon be removed
            self.storage.upload(file, key)

    def _near_file(self, name: str) -> Path | None:
        """The file that has the name of a scene in a near storage, by one or two looks at the disk."""
        paths = (self.storage.in_place(self._key(f"{name}{suffix}")) for suffix in SUFFIXES)
        return next((path for path in paths if path is not None and path.is_file()), None)

    def _known_as(self, name: str) -> Placed | None:
        """One scene as it was found last; None where that is too long ago."""
        if self.is_near:
            return self.look_up(name)
        return self._known.get(name) if self.is_usable else None

    def _scenes(self) -> dict[str, Placed]:
        if self.is_near:
            return self._scan()
        if not self.is_usable:
            self.read()
        elif self._thread is None and time.monotonic() - self._tried_at_s > _OLD_S:
            with contextlib.suppress(StorageUnavailable):
                self.read()
        return self._known

    def _get(self, name: str) -> Placed | None:
        if self.is_near:
            return self.look_up(name)
        if (placed := self._scenes().get(name)) is not None:
            return placed
        if self.problem is not None:
            raise self.problem  # it may be there
        if (placed := self.look_up(name)) is not None:
            self._change(name, placed)
        return placed

    def _placed(self, name: str) -> Placed:
        if (placed := self._get(name)) is None:
            raise FileNotFoundError(name)
        return placed

    def _cached(self, placed: Placed, *, counts: bool) -> Pin | None:
        assert self._cache is not None
        return self._cache.held(cache_name(self.storage, placed.key, placed.version, placed.sha256), counts=counts)

    def _fetched(self, placed: Placed) -> Path:
        """Raises NotThere, StorageFull."""
        assert self._cache is not None
        try:
            pin = None if self.problem is None else self._cached(placed, counts=True)
            if pin is None and self.problem is not None:  # a bucket that is away keeps nobody waiting
                raise self.problem
            with pin or self._cache.pin(self.storage, placed.key, placed.version, placed.sha256) as path:
                return path
        except Damaged as error:
            raise StorageUnavailable(str(error)) from None

    def _change(self, name: str, placed: Placed | None) -> None:
        with self._changing:
            self._changes += 1
            self._known = {other: one for other, one in self._known.items() if other != name}
            if placed is not None:
                self._known[name] = placed

    def _read(self) -> bool:
        """Whether the list could be read without a change by this process meanwhile, which it would undo."""
        changes, began_s = self._changes, time.monotonic()
        scenes = self._scan()
        with self._changing:
            if self._changes != changes:
                return False
            self._known, self._read_at_s = scenes, began_s
        return True

    def _scan(self) -> dict[str, Placed]:
        copied: dict[str, Placed] = {}
        entries: dict[str, Entry] = {}
        for entry in self.storage.entries_in(self._prefix):
            path = PurePosixPath(entry.key)
            if path.suffix in SUFFIXES and not is_scene_name(path.stem):
                if entry.key not in self._misnamed and not path.name.startswith("."):
                    self._misnamed.add(entry.key)
                    _log.warning(
                        f"{entry.key!r} in {self.storage.location} is not served: scenes are served by the name of "
                        "their file, at most 128 letters (a-z, A-Z), digits, '.', '_', '-', the first a letter or digit"
                    )
            elif path.suffix in SUFFIXES:
                if path.suffix == SUFFIX or path.stem not in copied:
                    copied[path.stem] = Placed(entry.key, entry.version, entry.bytes, None)
            elif is_scene_name(path.stem) and path.suffix == ENTRY_SUFFIX:
                entries[path.stem] = entry
        known = {name: self._entries[name] for name in entries if name in self._entries}
        new = [name for name, entry in entries.items() if name not in known or known[name][0] != entry.version]
        if new:
            with ThreadPoolExecutor(_READ_AT_ONCE) as threads:
                places = threads.map(self._read_entry, (entries[name].key for name in new))
                known |= {name: (entries[name].version, placed) for name, placed in zip(new, places, strict=True)}
        self._entries = known
        return {name: placed for name, (_, placed) in known.items() if placed is not None} | copied

    def _read_entry(self, key: str) -> Placed | None:
        """What the NAME.json of a key says; None where there is none, or nobody can read it."""
        try:
            document: Any = json.loads(self.storage.read(key))
            sha256, size = str(document["sha256"]), int(document["bytes"])
            if document["format_version"] != _FORMAT_VERSION:
                raise ValueError(f"its format_version is {document['format_version']}")
        except NotThere:
            return None
        except (ValueError, KeyError, TypeError) as error:
            _log.warning(f"{key} in {self.storage.location} describes no scene: {error}")
            return None
        return Placed(self._object(sha256), sha256, size, sha256)

    def _object(self, sha256: str) -> str:
        return self._key(f"{OBJECTS}/{sha256}{SUFFIX}")

    def _entry_key(self, name: str) -> str:
        return self._key(f"{name}{ENTRY_SUFFIX}")

    def _key(self, name: str) -> str:
        return f"{self._prefix}/{name}" if self._prefix else name

    def _follow(self) -> None:
        rounds = Rounds(f"reading the list of the scenes of {self.storage.location}", _log)
        kept_house_s = time.monotonic()
        while not self._stop.wait(FRESH_S):
            with rounds.round():
                was = self.problem
                try:
                    self.read()
                    if was is not None:
                        _log.warning(f"{self.storage.location} answers again")
                    if time.monotonic() - kept_house_s > HOUSEKEEPING_S:
                        kept_house_s = time.monotonic()
                        self.remove_unused()
                except StorageUnavailable as error:
                    if was is None:
                        _log.warning(f"{error.detail}; scenes that are cached are served meanwhile")


def _entry_text(sha256: str, size: int) -> bytes:
    """What NAME.json says of an object."""
    created_at = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
    document = {"format_version": _FORMAT_VERSION, "sha256": sha256, "bytes": size, "created_at": created_at}
    return (json.dumps(document) + "\n").encode()


_FIRST_READ_BYTES = 64 * 1024  # most headers with their poses
_LENGTH_BYTES = 8
_KEPT_BYTES = 128 * 2**20  # of headers: training poses, and what metadata becomes
_OBJECT_BYTES_PER_TEXT_BYTE = 30  # of the most wasteful metadata: empty lists in a list


def floats_per_gaussian(info: SceneInfo) -> int:
    """The number of a Gaussian's parameters in a scene."""
    return 3 + 3 + 4 + 1 + (info.sh_degree + 1) ** 2  # means, scales, quats, transmittances, SH


def fetch_header(storage: Storage, key: str, file_bytes: int, name: str) -> SceneHeader:
    """The header of the scene file that an object of so many bytes is, by two or three reads of parts of it.

    Raises NotThere, StorageUnavailable, and SceneFileInvalid, which calls the file `name`.
    """
    start = storage.read(key, length=_FIRST_READ_BYTES)
    try:
        check_header_size(start)
        header_bytes = _LENGTH_BYTES + int.from_bytes(start[:_LENGTH_BYTES], "little")
        if header_bytes > len(start):
            start += storage.read(key, start=len(start), length=header_bytes - len(start))
        tensors = json.loads(start[_LENGTH_BYTES:header_bytes])
        parts = [tensors[one]["data_offsets"] for one in ("training_poses", *BESIDE) if one in tensors]
        ranges = [(header_bytes + int(first), header_bytes + int(stop)) for first, stop in parts]
    except (ValueError, KeyError, TypeError) as error:
        raise scene_file_invalid(name, error) from error
    with tempfile.NamedTemporaryFile(prefix="ultragray-header-") as sparse:  # the Gaussians are a hole in it
        sparse.write(start[:header_bytes])
        for first, stop in ranges:
            if first < stop <= file_bytes:
                sparse.seek(first)
                sparse.write(storage.read(key, start=first, length=stop - first))
        sparse.truncate(file_bytes)
        sparse.flush()
        try:
            return read_header(sparse.name)
        except SceneFileInvalid as error:
            raise SceneFileInvalid(error.detail.replace(sparse.name, name)) from None


class KeptHeaders:
    """The headers that were used last, within a budget. Its methods may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: OrderedDict[str, tuple[Hashable, SceneHeader]] = OrderedDict()  # least recently used first
        self._bytes = 0

    def get(self, name: str, version: Hashable) -> SceneHeader | None:
        """The header of a scene if it is of this version; one of another version is dropped."""
        with self._lock:
            entry = self._kept.get(name)
            if entry is None or entry[0] != version:
                self._drop(name)
                return None
            self._kept.move_to_end(name)
            return entry[1]

    def keep(self, name: str, version: Hashable, header: SceneHeader) -> None:
        with self._lock:
            self._drop(name)
            self._kept[name] = version, header
            self._bytes += _described_bytes(header)
            while self._bytes > _KEPT_BYTES:
                self._drop(next(iter(self._kept)))

    def drop(self, name: str) -> None:
        with self._lock:
            self._drop(name)

    def _drop(self, name: str) -> None:
        if (entry := self._kept.pop(name, None)) is not None:
            self._bytes -= _described_bytes(entry[1])


def _described_bytes(header: SceneHeader) -> int:
    """The memory of a header in bytes: its text takes more as objects."""
    return header.training_poses.nbytes + _OBJECT_BYTES_PER_TEXT_BYTE * header.text_bytes
