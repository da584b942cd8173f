"""The scene files of one or more folders, and what a loaded scene costs. Free of torch."""

from __future__ import annotations

import re
import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ultragray.errors import InvalidArgument, SceneFileInvalid
from ultragray.scene_info import SceneHeader, SceneInfo, read_header, scene_file_invalid

from .errors import SceneNotFound, known_names
from .storage.local import FileVersion

SUFFIX = ".ugr"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")

# What the kernel prepares of a scene once (axes, activations, bounds) takes about 1.5 times the raw parameters.
_RESIDENT_PER_RAW_BYTE = 2.5
_KEPT_HEADER_BYTES = 128 * 2**20  # of headers: training poses, and what metadata becomes
_OBJECT_BYTES_PER_TEXT_BYTE = 30  # of the most wasteful metadata: empty lists in a list


def resident_bytes(info: SceneInfo) -> int:
    """Memory of a loaded scene in a worker: its raw float32 parameters and what the kernel prepares of them."""
    floats = _floats_per_gaussian(info)
    if info.label_names:
        floats += 3 + 3 + 4 + 1 + 1  # the parts by label, of degree 0
    return int(_RESIDENT_PER_RAW_BYTE * 4 * floats * info.gaussian_count)


def _floats_per_gaussian(info: SceneInfo) -> int:
    return 3 + 3 + 4 + 1 + (info.sh_degree + 1) ** 2  # means, scales, quats, transmittances, SH


class _KeptHeaders:
    """The headers that were used last, within a budget. Its methods may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: OrderedDict[str, tuple[FileVersion, SceneHeader]] = OrderedDict()  # least recently used first
        self._bytes = 0

    def get(self, name: str, version: FileVersion) -> SceneHeader | None:
        """The header of a scene if it is of this version; one of another version is dropped."""
        with self._lock:
            kept = self._kept.get(name)
            if kept is None or kept[0] != version:
                self._drop(name)
                return None
            self._kept.move_to_end(name)
            return kept[1]

    def keep(self, name: str, version: FileVersion, header: SceneHeader) -> None:
        with self._lock:
            self._drop(name)
            self._kept[name] = version, header
            self._bytes += _described_bytes(header)
            while self._bytes > _KEPT_HEADER_BYTES:
                self._drop(next(iter(self._kept)))

    def drop(self, name: str) -> None:
        with self._lock:
            self._drop(name)

    def _drop(self, name: str) -> None:
        if (kept := self._kept.pop(name, None)) is not None:
            self._bytes -= _described_bytes(kept[1])


def _described_bytes(header: SceneHeader) -> int:
    """Of a scene file without its Gaussians, as what is read from it: text becomes objects."""
    bytes_per_gaussian = 4 * _floats_per_gaussian(header.info) + bool(header.info.label_names)
    gaussians_bytes = bytes_per_gaussian * header.info.gaussian_count
    text_bytes = header.file_bytes - gaussians_bytes - header.training_poses.nbytes
    return header.training_poses.nbytes + _OBJECT_BYTES_PER_TEXT_BYTE * max(text_bytes, 0)


class SceneStore:
    """The scenes of some folders: `NAME.ugr` is the scene NAME, in the first folder that has it.

    Files and folders may come, change and go at any time.
    """

    def __init__(self, *folders: Path) -> None:
        self.folders = tuple(Path(folder) for folder in folders)
        self.hides: Callable[[str], bool] = lambda name: False  # from whoever asks: what is hidden is not found
        self._headers = _KeptHeaders()

    def names(self) -> list[str]:
        """The names of all scenes, sorted; files whose name could not stand in a URL are left out."""
        return sorted({name for folder in self.folders for name in _names_in(folder)})

    def shown_names(self) -> list[str]:
        """As `names`, without those that are hidden."""
        return [name for name in self.names() if not self.hides(name)]

    def names_of(self, folder: Path) -> set[str]:
        """The names of the scenes that are those of one of the folders: none before it has the name."""
        before = self.folders[: self.folders.index(folder)]
        return set(_names_in(folder)).difference(*map(_names_in, before))

    def path(self, name: str) -> Path:
        """The file of a scene. Raises SceneNotFound, also for a name that no scene can have."""
        if _NAME.fullmatch(name) and not self.hides(name) and (path := self.file(name)).is_file():
            return path
        raise self._not_found(name)

    def file(self, name: str) -> Path:
        """The path of a scene's file; in the first folder where there is none."""
        paths = [folder / f"{name}{SUFFIX}" for folder in self.folders]
        return next((path for path in paths if path.is_file()), paths[0])

    def header(self, name: str) -> SceneHeader:
        """A scene's description and training poses. Raises SceneNotFound, SceneFileInvalid."""
        return self.versioned_header(name)[1]

    def versioned_header(self, name: str) -> tuple[FileVersion, SceneHeader]:
        """The same, with the version of the file that it is of."""
        version = self.version(name)  # before reading, so that a change meanwhile counts as newer
        cached = self._headers.get(name, version)
        if cached is not None:
            return version, cached
        header = read_header(self.file(name))
        self._headers.keep(name, version, header)
        return version, header

    def version(self, name: str) -> FileVersion:
        """The version of a scene's file as it is now. Raises SceneNotFound, SceneFileInvalid."""
        path = self.path(name)
        try:
            return FileVersion.of(path)
        except FileNotFoundError:
            raise self._not_found(name) from None
        except OSError as error:
            raise scene_file_invalid(path, error) from error

    def cached_versioned_header(self, name: str) -> tuple[FileVersion, SceneHeader] | None:
        """The versioned header if it was read before and the file is unchanged, at the cost of one stat."""
        if self.hides(name):
            return None
        try:
            version = FileVersion.of(self.file(name))
        except (OSError, ValueError):  # ValueError: no file can have the name
            self._headers.drop(name)
            return None
        header = self._headers.get(name, version)
        return None if header is None else (version, header)

    def forget(self, name: str) -> None:
        """Drops what is kept of a scene that was deleted."""
        self._headers.drop(name)

    def _not_found(self, name: str) -> SceneNotFound:
        return SceneNotFound(
            f"there is no scene {name[:128]!r}; {known_names('scene', self.shown_names())}", field="scene"
        )


def check_scene_name(name: Any, field: str = "scene") -> None:
    """Raises InvalidArgument for a name that no scene can have."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InvalidArgument(
            f"{field} must be 1 to 128 letters, digits, '.', '_', '-', got {str(name)[:128]!r}", field=field
        )


def _names_in(folder: Path) -> list[str]:
    try:
        entries = list(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []
    return [
        entry.stem for entry in entries if entry.suffix == SUFFIX and _NAME.fullmatch(entry.stem) and entry.is_file()
    ]


def check_scene_file(path: str) -> None:
    """Load a scene file that somebody sent, in a helper process. Raises SceneFileInvalid, which calls it the body."""
    try:
        read_header(path)
        from ultragray.scene import GaussianScene  # torch, which a file that is no scene does not need

        GaussianScene.load(path)
    except SceneFileInvalid as error:
        raise SceneFileInvalid(error.detail.replace(path, "the body"), field="body") from error
