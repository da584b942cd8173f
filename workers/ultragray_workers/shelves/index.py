"""The scenes of a bucket, and how one is added or removed by any of its services.

PREFIX/NAME.ugr              a scene as an operator copied it there
PREFIX/NAME.json             a scene that was imported or that a job made: {"format_version", "sha256", "bytes", …}
PREFIX/objects/SHA256.ugr    the file of such scenes, which never changes

A name is given by one conditional write of its NAME.json, so that no service overwrites the scene of another.
"""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from ultragray.files import file_sha256
from ultragray_workers.errors import SceneExists, StorageUnavailable
from ultragray_workers.scene_names import SUFFIX, is_scene_name
from ultragray_workers.storage.storage import Entry, NotThere, Storage

OBJECTS, ENTRY_SUFFIX = "objects", ".json"
FRESH_S = 2.0  # after which the list is read again by whoever follows it
_OLD_S = 2.5 * FRESH_S  # and by whoever asks
UNUSED_AFTER_S = 86_400.0  # objects that no name has had so long are removed
_FORMAT_VERSION = 1
_READ_AT_ONCE = 8

_log = logging.getLogger("ultragray.scenes")


@dataclass(frozen=True)
class Placed:
    """Where the file of a scene is."""

    key: str
    version: str  # tells one content of the scene from the next
    bytes: int
    sha256: str | None  # None: of a scene that was copied there, until it was fetched


class SceneIndex:
    """The scenes below a prefix of a bucket, as they were found last. Its methods may be called from any thread."""

    def __init__(self, storage: Storage, prefix: str, longest_stale_s: float = 0.0) -> None:
        """`longest_stale_s`: how long what was found last counts where the bucket does not answer."""
        self.storage, self._prefix, self._longest_stale_s = storage, prefix, longest_stale_s
        self._known: dict[str, Placed] = {}
        self._read_at_s: float | None = None  # time.monotonic()
        self._tried_at_s = 0.0
        self.is_followed = False  # told by who reads it again and again: others need not, and are not kept waiting
        self._entries: dict[str, tuple[str, Placed]] = {}  # by name: the version of NAME.json, and what it said
        self._changes = 0  # by this process
        self._changing, self._reading = threading.Lock(), threading.Lock()
        self.problem: StorageUnavailable | None = None  # of the last reading
        self.unavailable_total = 0

    @property
    def age_s(self) -> float:
        """Since the list was read last."""
        return float("inf") if self._read_at_s is None else time.monotonic() - self._read_at_s

    @property
    def is_usable(self) -> bool:
        """Whether scenes are served as they were found last."""
        return self.age_s <= self._longest_stale_s

    def known(self) -> dict[str, Placed]:
        """The scenes as they were found last; none where that is too long ago."""
        return self._known if self.is_usable else {}

    def scenes(self) -> dict[str, Placed]:
        """The scenes as they are, or were at most `longest_stale_s` ago. Raises StorageUnavailable."""
        if self.age_s > self._longest_stale_s:
            self.read()
        elif not self.is_followed and time.monotonic() - self._tried_at_s > _OLD_S:
            with contextlib.suppress(StorageUnavailable):
                self.read()
        return self._known

    def get(self, name: str) -> Placed | None:
        """One scene, also one that has just been added by another service. Raises StorageUnavailable."""
        if (placed := self.scenes().get(name)) is not None:
            return placed
        if self.problem is not None:
            raise self.problem  # it may be there
        placed = self.look_up(name)
        if placed is not None:
            with self._changing:
                self._changes += 1
                self._known = {**self._known, name: placed}
        return placed

    def look_up(self, name: str) -> Placed | None:
        """One scene as it is now. Raises StorageUnavailable."""
        if (named := self._read_entry(self._entry(name))) is not None:
            return named
        copied = self.storage.entry(self._key(f"{name}{SUFFIX}"))
        return None if copied is None else Placed(copied.key, copied.version, copied.bytes, None)

    def read(self) -> None:
        """Reads the list. Raises StorageUnavailable."""
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

    def publish(self, file: Path, name: str) -> None:
        """Makes a file the scene of a name; nothing where it is already. Raises SceneExists, StorageUnavailable."""
        sha256, size = file_sha256(file), file.stat().st_size
        there = self.look_up(name)
        if there is not None and there.sha256 != sha256:
            raise SceneExists(f"there is already a scene {name!r}", field="scene")
        key = self._object(sha256)
        self._upload(file, key)
        placed = Placed(key, sha256, size, sha256)
        document = {
            "format_version": _FORMAT_VERSION,
            "sha256": sha256,
            "bytes": size,
            "created_at": datetime.now(timezone.utc).isoformat(timespec="milliseconds"),
        }
        if there is None and not self.storage.write(
            self._entry(name), (json.dumps(document) + "\n").encode(), if_absent=True
        ):
            there = self.look_up(name)
            if there is None or there.sha256 != sha256:
                raise SceneExists(f"there is already a scene {name!r}", field="scene")
        if self.storage.entry(key) is None:  # removed as unused the very moment before it was named
            self._upload(file, key)
        self._change(name, placed)

    def remove(self, name: str) -> bool:
        """Removes the scene of a name; False where there was none. Raises StorageUnavailable."""
        there = self.look_up(name)
        if there is not None:
            self.storage.delete(there.key if there.sha256 is None else self._entry(name))
        self._change(name, None)
        return there is not None

    def remove_unused(self, older_than_s: float = UNUSED_AFTER_S) -> int:
        """Removes the objects that no name has; how many there were. Raises StorageUnavailable."""
        before = time.time() - older_than_s
        old = [one for one in self.storage.entries_in(self._key(OBJECTS)) if one.modified < before]
        if not old:
            return 0
        used = {placed.key for placed in self._found(self._listed()).values()}  # after the objects were listed
        unused = [one for one in old if one.key not in used]
        removed = 0
        for one in unused:
            now = self.storage.entry(one.key)
            if now is not None and now.modified < before:  # else somebody has just uploaded it again
                self.storage.delete(one.key)
                removed += 1
        return removed

    def _upload(self, file: Path, key: str) -> None:
        there = self.storage.entry(key)
        if there is None or time.time() - there.modified > UNUSED_AFTER_S / 2:  # else it might soon be removed
            self.storage.upload(file, key)

    def _change(self, name: str, placed: Placed | None) -> None:
        with self._changing:
            self._changes += 1
            self._known = {other: one for other, one in self._known.items() if other != name}
            if placed is not None:
                self._known[name] = placed

    def _read(self) -> bool:
        """Whether the list could be read without a change by this process meanwhile, which it would undo."""
        changes, began_s = self._changes, time.monotonic()
        found = self._found(self._listed())
        with self._changing:
            if self._changes != changes:
                return False
            self._known, self._read_at_s = found, began_s
        return True

    def _listed(self) -> list[Entry]:
        return list(self.storage.entries_in(self._prefix))

    def _found(self, entries: Iterable[Entry]) -> dict[str, Placed]:
        copied: dict[str, Placed] = {}
        named: dict[str, Entry] = {}
        for entry in entries:
            file = entry.key.rpartition("/")[2]
            if (name := file.removesuffix(SUFFIX)) != file and is_scene_name(name):
                copied[name] = Placed(entry.key, entry.version, entry.bytes, None)
            elif (name := file.removesuffix(ENTRY_SUFFIX)) != file and is_scene_name(name):
                named[name] = entry
        new = [one for one in named.items() if self._entries.get(one[0], ("", None))[0] != one[1].version]
        if new:
            with ThreadPoolExecutor(_READ_AT_ONCE) as threads:
                told = dict(threads.map(lambda one: (one[0], (one[1].version, self._read_entry(one[1].key))), new))
        else:
            told = {}
        kept = {name: told.get(name) or self._entries[name] for name in named}
        self._entries = {name: (version, placed) for name, (version, placed) in kept.items() if placed is not None}
        return copied | {name: placed for name, (_, placed) in self._entries.items()}

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

    def _entry(self, name: str) -> str:
        return self._key(f"{name}{ENTRY_SUFFIX}")

    def _key(self, name: str) -> str:
        return f"{self._prefix}/{name}" if self._prefix else name
