"""The scenes that a worker process holds where it renders them: loaded on demand, the least recently used evicted
within a memory budget.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import cached_property

import torch

from ultragray.errors import MemoryExceeded, SceneFileInvalid, UltragrayError
from ultragray.files import file_sha256
from ultragray.scene.confidence import Assessor
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import read_header, scene_file_invalid
from ultragray_workers.errors import SceneTooLarge
from ultragray_workers.scenes import resident_bytes
from ultragray_workers.storage.local import FileVersion

MAX_SCENES = 256
_READ_ATTEMPTS = 3


@dataclass(frozen=True, eq=False)
class LoadedScene:
    scene: GaussianScene
    sha256: str  # of the very bytes the tensors were read from
    version: FileVersion
    bytes: int

    @cached_property
    def assessor(self) -> Assessor:
        """The assessor of its frames' extrapolation."""
        return Assessor(self.scene.info, self.scene.training_poses)


class SceneCache:
    """At most `budget_bytes` of scenes on a device, as `resident_bytes` counts them."""

    def __init__(self, budget_bytes: int, device: torch.device) -> None:
        self._budget_bytes = budget_bytes
        self._device = device
        self._scenes: OrderedDict[str, LoadedScene] = OrderedDict()  # least recently used first

    def names(self) -> tuple[str, ...]:
        return tuple(self._scenes)

    def get(self, name: str, path: str) -> LoadedScene:
        """The scene of a file as it is now. Raises SceneFileInvalid, SceneTooLarge, MemoryExceeded."""
        if (held := self.held(name, path)) is not None:
            return held
        self._make_room(name, path)
        self._scenes[name] = loaded = self._load(name, path)
        return loaded

    def held(self, name: str, path: str) -> LoadedScene | None:
        """The scene where it need not be loaded: it is here, and its file is the same. Raises SceneFileInvalid."""
        try:
            version = _version(path)
        except SceneFileInvalid:
            self.drop(name)
            raise
        held = self._scenes.get(name)
        if held is not None and held.version == version:
            self._scenes.move_to_end(name)
            return held
        self.drop(name)
        return None

    def drop(self, name: str) -> None:
        self._scenes.pop(name, None)

    def _make_room(self, name: str, path: str) -> None:
        needed = resident_bytes(read_header(path).info)
        if needed > self._budget_bytes:
            raise SceneTooLarge(
                f"scene {name!r} needs {_megabytes(needed)}, the memory budget for scenes is "
                f"{_megabytes(self._budget_bytes)}",
                field="scene",
            )
        while self._scenes and (self._held_bytes() + needed > self._budget_bytes or len(self._scenes) >= MAX_SCENES):
            self._scenes.popitem(last=False)

    def _load(self, name: str, path: str) -> LoadedScene:
        loaded = _read(path)
        try:
            return replace(loaded, scene=loaded.scene.to(self._device))
        except torch.OutOfMemoryError as error:
            raise MemoryExceeded(
                f"scene {name!r} of {_megabytes(loaded.bytes)} does not fit into the free memory of {self._device}; "
                f"the memory budget for scenes is {_megabytes(self._budget_bytes)}, a lower one leaves more room",
                field="scene",
            ) from error

    def _held_bytes(self) -> int:
        return sum(loaded.bytes for loaded in self._scenes.values())


def _read(path: str) -> LoadedScene:
    """Tensors and hash of the same bytes: read again when the file changed in between."""
    for _ in range(_READ_ATTEMPTS):
        version = _version(path)
        try:
            scene, sha256 = GaussianScene.load(path), file_sha256(path)
        except (UltragrayError, OSError) as error:
            if _version(path) == version:
                raise (error if isinstance(error, UltragrayError) else scene_file_invalid(path, error)) from error
            continue
        if _version(path) == version:
            return LoadedScene(scene=scene, sha256=sha256, version=version, bytes=resident_bytes(scene.info))
    raise SceneFileInvalid(f"{path}: it changed {_READ_ATTEMPTS} times while it was being read")


def _version(path: str) -> FileVersion:
    try:
        return FileVersion.of(path)
    except OSError as error:
        raise scene_file_invalid(path, error) from error


def _megabytes(count: int) -> str:
    return f"{count / 2**20:.1f} MiB"
