"""A bucket of scenes: fetched when they are asked for, into a cache of this host."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ultragray.scene.info import SceneHeader, read_header
from ultragray_workers.claims import claimed_folder, remove_abandoned
from ultragray_workers.errors import StorageUnavailable
from ultragray_workers.rounds import Rounds
from ultragray_workers.scene_names import SUFFIX
from ultragray_workers.shelves.folder import MAKING_PREFIX
from ultragray_workers.shelves.headers import KeptHeaders, fetch_header
from ultragray_workers.shelves.index import FRESH_S, Placed, SceneIndex
from ultragray_workers.storage.cache import Cache, Pin, cache_name
from ultragray_workers.storage.storage import NotThere

LET_GO_S = 10.0  # after which a file that nobody has asked for may leave the cache
HOUSEKEEPING_S = 3600.0

_log = logging.getLogger("ultragray.scenes")


@dataclass
class _Held:
    """A file of the cache that stays for now."""

    pin: Pin
    users: int = 0
    used_at_s: float = field(default_factory=time.monotonic)


class BucketShelf:
    """The scenes below a prefix of a bucket."""

    def __init__(self, index: SceneIndex, cache: Cache, working_folder: Path) -> None:
        """`working_folder`: of this host, for scenes that are being made."""
        self.index, self.cache = index, cache
        self._working_folder = working_folder
        self._headers: KeptHeaders[str] = KeptHeaders()
        self._held: dict[str, _Held] = {}  # by the name in the cache
        self._holding = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def follow(self) -> None:
        """From now on the list of the scenes is read every FRESH_S seconds, in a thread of its own."""
        self.index.is_followed = True
        self._thread = threading.Thread(target=self._follow, name="scenes of a bucket", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends what `follow` began, and lets all files go."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        self._let_go(0.0)

    def names(self) -> set[str]:
        return set(self.index.scenes())

    def has(self, name: str) -> bool:
        return self.index.get(name) is not None

    def knows(self, name: str) -> bool:
        return name in self.index.known()

    def here(self, name: str) -> Path | None:
        if (placed := self.index.known().get(name)) is None:
            return None
        with self._holding:
            held = self._held.get(self._cache_name(placed))
            if held is None:
                return None
            held.used_at_s = time.monotonic()
            return held.pin.path

    def fetch(self, name: str) -> Path:
        placed = self._placed(name)
        if (path := self.here(name)) is not None:
            return path
        try:
            pin = self._pin(placed)
        except NotThere:  # replaced or removed since the list was read
            self.index.read()
            try:
                placed = self._placed(name)
                pin = self._pin(placed)
            except NotThere as error:
                raise StorageUnavailable(f"the scene {name!r} has no file: {error}") from None
        with self._holding:
            held = self._held.setdefault(self._cache_name(placed), _Held(pin))
            held.used_at_s = time.monotonic()
        if held.pin is not pin:  # another thread was quicker
            pin.let_go()
        return held.pin.path

    @contextlib.contextmanager
    def hold(self, name: str) -> Iterator[Path | None]:
        placed = self.index.known().get(name)
        with self._holding:
            held = None if placed is None else self._held.get(self._cache_name(placed))
            if held is not None:
                held.users += 1
        if held is None:
            yield None
            return
        self.cache.count_hit()
        try:
            yield held.pin.path
        finally:
            with self._holding:
                held.users -= 1
                held.used_at_s = time.monotonic()

    def header(self, name: str) -> SceneHeader:
        placed = self._placed(name)
        if (kept := self._headers.get(name, placed.version)) is not None:
            return kept
        if (path := self.here(name)) is not None:
            header = read_header(path)
        elif (problem := self.index.problem) is not None:
            raise problem
        else:
            try:
                header = fetch_header(self.index.storage, placed.key, placed.bytes, f"{name}{SUFFIX}")
            except NotThere:
                raise FileNotFoundError(name) from None
        self._headers.keep(name, placed.version, header)
        return header

    def bytes_of(self, name: str) -> int:
        placed = self.index.scenes().get(name)
        return 0 if placed is None else placed.bytes

    def sha256(self, name: str) -> str | None:
        placed = self.index.get(name)
        return None if placed is None else placed.sha256

    def publish(self, file: Path, name: str) -> None:
        self.index.publish(file, name)

    def remove(self, name: str) -> bool:
        self._headers.drop(name)
        return self.index.remove(name)

    @contextlib.contextmanager
    def making(self) -> Iterator[Path]:
        with claimed_folder(self._working_folder, MAKING_PREFIX) as folder, self.index.storage.claimed(folder.name):
            yield folder

    def is_making(self, token: str) -> bool:
        return self.index.storage.is_claimed(token)

    def remove_abandoned(self) -> None:
        remove_abandoned(self._working_folder, MAKING_PREFIX)

    def _placed(self, name: str) -> Placed:
        if (placed := self.index.get(name)) is None:
            raise FileNotFoundError(name)
        return placed

    def _pin(self, placed: Placed) -> Pin:
        if (problem := self.index.problem) is not None:  # a bucket that is away keeps nobody waiting
            if (pin := self.cache.held(self._cache_name(placed))) is None:
                raise problem
            return pin
        return self.cache.pin(self.index.storage, placed.key, placed.version, placed.sha256)

    def _cache_name(self, placed: Placed) -> str:
        return cache_name(self.index.storage, placed.key, placed.version, placed.sha256)

    def _follow(self) -> None:
        rounds = Rounds(f"reading the list of the scenes of {self.index.storage.location}", _log)
        kept_house_s = time.monotonic()
        while not self._stop.wait(FRESH_S):
            with rounds.round():
                was = self.index.problem
                try:
                    self.index.read()
                    if was is not None:
                        _log.warning(f"{self.index.storage.location} answers again")
                    if time.monotonic() - kept_house_s > HOUSEKEEPING_S:
                        kept_house_s = time.monotonic()
                        self.index.remove_unused()
                except StorageUnavailable as error:
                    if was is None:
                        _log.warning(f"{error.detail}; scenes that are cached are served meanwhile")
                self._let_go(LET_GO_S)

    def _let_go(self, after_s: float) -> None:
        """Lets the files go that nobody uses, or has asked for lately."""
        before = time.monotonic() - after_s
        with self._holding:
            idle = [name for name, held in self._held.items() if held.users == 0 and held.used_at_s <= before]
            for name in idle:
                self._held.pop(name).pin.let_go()
