"""A folder of scenes: `NAME.ugr` is the scene NAME, used in place. Files may come, change and go at any time."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from ultragray.files import file_sha256, link_or_copy, sync
from ultragray.scene.info import SceneHeader, read_header
from ultragray_workers.claims import claimed_folder, remove_abandoned
from ultragray_workers.errors import SceneExists
from ultragray_workers.scene_names import SUFFIX, is_scene_name
from ultragray_workers.storage.local import LocalStorage
from ultragray_workers.storage.storage import Storage

MAKING_PREFIX = ".importing-"


class FolderShelf:
    """The scenes of a folder, which need not exist yet."""

    def __init__(self, folder: Path, storage: Storage | None = None) -> None:
        """`storage`: by which services claim what they make; None: the folder."""
        self.folder = Path(folder)
        self._storage = storage or LocalStorage(self.folder)

    def names(self) -> set[str]:
        try:
            entries = list(self.folder.iterdir())
        except (FileNotFoundError, NotADirectoryError):
            return set()
        return {path.stem for path in entries if path.suffix == SUFFIX and is_scene_name(path.stem) and path.is_file()}

    def has(self, name: str) -> bool:
        return self.path(name).is_file()

    def knows(self, name: str) -> bool:
        return self.has(name)

    def here(self, name: str) -> Path | None:
        path = self.path(name)
        return path if path.is_file() else None

    def fetch(self, name: str) -> Path:
        if (path := self.here(name)) is None:
            raise FileNotFoundError(name)
        return path

    @contextlib.contextmanager
    def hold(self, name: str) -> Iterator[Path | None]:
        yield self.here(name)

    def header(self, name: str) -> SceneHeader:
        return read_header(self.fetch(name))

    def bytes_of(self, name: str) -> int:
        try:
            return self.path(name).stat().st_size
        except FileNotFoundError:
            return 0

    def sha256(self, name: str) -> str | None:
        return None

    def publish(self, file: Path, name: str) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        target = self.path(name)
        link_or_copy(file, target)
        if not target.samefile(file) and file_sha256(target) != file_sha256(file):  # another one was quicker
            raise SceneExists(f"there is already a scene {name!r}", field="scene")

    def remove(self, name: str) -> bool:
        try:
            self.path(name).unlink()
        except FileNotFoundError:
            return False
        sync(self.folder)
        return True

    @contextlib.contextmanager
    def making(self) -> Iterator[Path]:
        with claimed_folder(self.folder, MAKING_PREFIX) as folder, self._storage.claimed(folder.name):
            yield folder

    def is_making(self, token: str) -> bool:
        return self._storage.is_claimed(token)

    def remove_abandoned(self) -> None:
        remove_abandoned(self.folder, MAKING_PREFIX)

    def path(self, name: str) -> Path:
        """Where the file of a scene is, or would be."""
        return self.folder / f"{name}{SUFFIX}"
