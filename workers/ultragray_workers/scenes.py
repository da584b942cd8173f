"""The scenes of one or more places, and what a loaded scene costs. Free of torch."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import BinaryIO

from ultragray.errors import SceneFileInvalid
from ultragray.files import file_sha256
from ultragray.scene.info import SceneHeader, SceneInfo, read_header, scene_file_invalid
from ultragray_workers.errors import SceneNotFound, known_names
from ultragray_workers.scene_names import SUFFIX, SceneReference, base_name, check_scene_name, is_scene_name
from ultragray_workers.scene_shelf import KeptHeaders, SceneShelf, floats_per_gaussian
from ultragray_workers.storage.local import FileVersion, LocalStorage

__all__ = ["SUFFIX", "SceneStore", "check_scene_file", "check_scene_name", "resident_bytes"]

# What the kernel prepares of a scene once (axes, activations, bounds) takes about 1.5 times the raw parameters.
_RESIDENT_PER_RAW_BYTE = 2.5
_ATTEMPTS = 3


def resident_bytes(info: SceneInfo) -> int:
    """Memory of a loaded scene in a worker: its raw float32 parameters and what the kernel prepares of them."""
    floats = floats_per_gaussian(info)
    if info.label_names:
        floats += 3 + 3 + 4 + 1 + 1  # the parts by label, of degree 0
    return int(_RESIDENT_PER_RAW_BYTE * 4 * floats * info.gaussian_count)


class SceneStore:
    """The scenes of some folders and buckets: of several that have a name, the first counts.

    A scene is asked for by its name, or by its name with a pin (see `scene_names`): then it must have that content.
    What blocks raises StorageUnavailable where a bucket does not answer.
    """

    def __init__(self, *places: Path | SceneShelf, hides: Callable[[str], bool] = lambda name: False) -> None:
        """`hides`: whether a scene is hidden from whoever asks, who does not find it then."""
        self.shelves = tuple(SceneShelf(LocalStorage(one)) if isinstance(one, Path) else one for one in places)
        self.hides = hides
        self._headers: KeptHeaders = KeptHeaders()
        self._hashes: dict[str, tuple[FileVersion, str]] = {}
        self._hashing = threading.Lock()

    def names(self) -> list[str]:
        """The names of all scenes, sorted; the log names files whose name could not stand in a URL."""
        return sorted({name for shelf in self.shelves for name in shelf.names()})

    def shown_names(self) -> list[str]:
        return [name for name in self.names() if not self.hides(name)]

    def names_of(self, shelf: SceneShelf) -> set[str]:
        """The names of the scenes that are those of one of the shelves: none before it has the name."""
        before = self.shelves[: self.shelves.index(shelf)]
        return shelf.names().difference(*(other.names() for other in before))

    def shelf_of(self, name: str) -> SceneShelf | None:
        return next((shelf for shelf in self.shelves if shelf.has(name)), None)

    def require(self, text: str) -> str:
        """The name of the scene that is asked for. Raises SceneNotFound, also for one that no scene can have."""
        return self._resolve(text)[0].name

    def path(self, text: str) -> Path:
        """The file of a scene, on this host from now on. Raises SceneNotFound, StorageFull."""
        reference, shelf = self._resolve(text)
        try:
            return shelf.fetch(reference.name)
        except FileNotFoundError:
            raise self._not_found(text) from None

    def open(self, text: str) -> BinaryIO:
        """The file of a scene, to be read as it is now, whatever takes its name meanwhile; raises as `path`."""
        try:
            return self.path(text).open("rb")
        except FileNotFoundError:
            raise self._not_found(text) from None

    def header(self, text: str) -> SceneHeader:
        """A scene's description and training poses. Raises SceneNotFound, SceneFileInvalid."""
        reference, shelf = self._resolve(text)
        if shelf.here(reference.name) is not None:
            return self.versioned_header(text)[1]
        try:
            version = shelf.version(reference.name)  # before reading, so that a change meanwhile counts as newer
            if (header := self._headers.get(reference.name, version)) is None:
                header = shelf.header(reference.name)
                self._headers.keep(reference.name, version, header)
            return header
        except FileNotFoundError:
            raise self._not_found(text) from None

    def versioned_header(self, text: str) -> tuple[FileVersion, SceneHeader]:
        """The same, with the version of the file that it is of; the file is fetched."""
        path, version = self._versioned(text)  # before reading, so that a change meanwhile counts as newer
        name = base_name(text)
        cached = self._headers.get(name, version)
        if cached is not None:
            return version, cached
        header = read_header(path)
        self._headers.keep(name, version, header)
        return version, header

    def version(self, text: str) -> FileVersion:
        """The version of a scene's file as it is now. Raises SceneNotFound, SceneFileInvalid."""
        return self._versioned(text)[1]

    def cached_versioned_header(self, text: str) -> tuple[FileVersion, SceneHeader] | None:
        """The versioned header if it was read before and the file is unchanged, at the cost of one stat."""
        reference = SceneReference.of(text)
        if reference is None or self.hides(reference.name):
            return None
        name = reference.name
        try:
            path = self._here(name)
            version = None if path is None else FileVersion.of(path)
        except (OSError, ValueError):
            version = None
        if version is None:
            self._headers.drop(name)
            return None
        if reference.pin is not None:
            hashed = self._hashes.get(name)
            if hashed is None or hashed[0] != version or not reference.fits(hashed[1]):
                return None
        header = self._headers.get(name, version)
        return None if header is None else (version, header)

    def hold(self, name: str) -> AbstractContextManager[Path] | None:
        """The file of a scene, which stays on this host until the context is left; None where it is not here now."""
        for shelf in self.shelves if is_scene_name(name) else ():
            if (hold := shelf.hold(name)) is not None or shelf.knows(name):
                return hold
        return None

    def sha256(self, text: str) -> str:
        """The hash of the content that a scene has now, its file fetched where nothing else tells it.

        Raises SceneNotFound, SceneFileInvalid.
        """
        reference, shelf = self._resolve(text)
        known = shelf.sha256(reference.name)
        return self._hash_of_file(reference.name, self.path(text))[1] if known is None else known

    def stored(self, name: str) -> tuple[str, int] | None:
        """A word that tells the content of a scene from others, and the bytes of its file; None where there is none."""
        if (shelf := self.shelf_of(name)) is None:
            return None
        known = shelf.sha256(name)
        if known is None and (path := shelf.here(name)) is not None:
            known = self._hash_of_file(name, path)[1]
        return known or name, shelf.bytes_of(name)

    def forget(self, name: str) -> None:
        self._headers.drop(name)
        self._hashes.pop(name, None)

    def _resolve(self, text: str) -> tuple[SceneReference, SceneShelf]:
        """The shelf of the scene that is asked for, with the content that is asked for. Raises SceneNotFound."""
        reference = SceneReference.of(text)
        if reference is None or self.hides(reference.name) or (shelf := self.shelf_of(reference.name)) is None:
            raise self._not_found(text)
        if reference.pin is not None:
            sha256 = shelf.sha256(reference.name)
            if sha256 is None:
                try:
                    _, sha256 = self._hash_of_file(reference.name, shelf.fetch(reference.name))
                except FileNotFoundError:
                    raise self._not_found(text) from None
            if not reference.fits(sha256):
                raise SceneNotFound(
                    f"the scene {reference.name!r} no longer has the content {reference.pin}; it is now "
                    f"{reference.name}@{sha256}",
                    field="scene",
                )
        return reference, shelf

    def _here(self, name: str) -> Path | None:
        shelf = next((shelf for shelf in self.shelves if shelf.knows(name)), None)
        return None if shelf is None else shelf.here(name)

    def _versioned(self, text: str) -> tuple[Path, FileVersion]:
        name, is_pinned = base_name(text), "@" in text
        for _ in range(_ATTEMPTS):
            path = self.path(text)
            try:
                version = FileVersion.of(path)
            except FileNotFoundError:
                raise self._not_found(text) from None
            except OSError as error:
                raise scene_file_invalid(path, error) from error
            if not is_pinned or self._hash_of_file(name, path)[0] == version:
                return path, version  # else it was replaced after its content was compared
        raise SceneFileInvalid(f"{path}: it changed {_ATTEMPTS} times while it was being read")

    def _hash_of_file(self, name: str, path: Path) -> tuple[FileVersion, str]:
        with self._hashing:  # one reads a file, the others learn of it
            try:
                version = FileVersion.of(path)
                known = self._hashes.get(name)
                if known is None or known[0] != version:
                    known = self._hashes[name] = (version, file_sha256(path))
            except FileNotFoundError:
                raise self._not_found(name) from None
            except OSError as error:
                raise scene_file_invalid(path, error) from error
            return known

    def _not_found(self, text: str) -> SceneNotFound:
        return SceneNotFound(
            f"there is no scene {text[:128]!r}; {known_names('scene', self.shown_names())}", field="scene"
        )


def check_scene_file(path: str) -> None:
    """Load a scene file that somebody sent, in a helper process. Raises SceneFileInvalid, which calls it the body."""
    try:
        read_header(path)
        from ultragray.scene.gaussians import GaussianScene  # torch, which a file that is no scene does not need

        GaussianScene.load(path)
    except SceneFileInvalid as error:
        raise SceneFileInvalid(error.detail.replace(path, "the body"), field="body") from error
