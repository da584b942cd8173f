"""The scenes of one replica: loaded ones within a memory budget, files within a bounded folder. Both drop what was
least recently used."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from .costs import SceneCosts, Storage

MAX_SCENES = 256  # that a render process keeps loaded, see ultragray_workers.pool.scene_cache


class Source(IntEnum):
    """Where a replica found a scene."""

    MEMORY = 0
    FOLDER = 1  # fetched before, loaded now
    STORAGE = 2  # fetched and loaded now


@dataclass(frozen=True)
class CacheSizes:
    """Bytes of a replica; the memory is that of its one render process."""

    memory: int = 4 * 2**30
    folder: int = 20 * 2**30


class ReplicaCache:
    """The scenes of one replica. `costs` has those of each scene."""

    def __init__(self, sizes: CacheSizes, costs: Sequence[SceneCosts], storage: Storage) -> None:
        self._sizes = sizes
        self._costs = costs
        self._storage = storage
        self._loaded: OrderedDict[int, float] = OrderedDict()  # the time from which each can be rendered
        self._loaded_bytes = 0
        self._files: OrderedDict[int, None] = OrderedDict()
        self._file_bytes = 0

    def ask(self, scene: int, now_s: float) -> tuple[Source, float]:
        """Where the scene is, and the time from which the render process can work on it."""
        loaded = self._loaded
        if scene in loaded:
            loaded.move_to_end(scene)
            ready_s = loaded[scene]
            return Source.MEMORY, ready_s if ready_s > now_s else now_s
        source, ready_s = self._file(scene, now_s)
        loaded[scene] = ready_s
        self._loaded_bytes += self._costs[scene].resident_bytes
        while len(loaded) > 1 and (self._loaded_bytes > self._sizes.memory or len(loaded) > MAX_SCENES):
            dropped, _ = loaded.popitem(last=False)
            self._loaded_bytes -= self._costs[dropped].resident_bytes
        return source, ready_s

    def _file(self, scene: int, now_s: float) -> tuple[Source, float]:
        files = self._files
        if scene in files:
            files.move_to_end(scene)
            return Source.FOLDER, now_s
        size = self._costs[scene].file_bytes
        files[scene] = None
        self._file_bytes += size
        while len(files) > 1 and self._file_bytes > self._sizes.folder:
            dropped, _ = files.popitem(last=False)
            self._file_bytes -= self._costs[dropped].file_bytes
        return Source.STORAGE, now_s + self._storage.fetch_s(size)
