"""The scene files of one or more folders, and what a loaded scene costs. Free of torch."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ultragray.errors import InvalidArgument, SceneNotFound
from ultragray.scene_info import SceneHeader, SceneInfo, read_header, scene_file_invalid

SUFFIX = ".ugr"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")
_NAMES_IN_MESSAGE = 5

# What the kernel prepares of a scene once (axes, activations, bounds) takes about 1.5 times the raw parameters.
_RESIDENT_PER_RAW_BYTE = 2.5


def resident_bytes(info: SceneInfo) -> int:
    """Memory of a loaded scene in a worker: its raw float32 parameters and what the kernel prepares of them."""
    floats_per_gaussian = 3 + 3 + 4 + 1 + (info.sh_degree + 1) ** 2  # means, scales, quats, transmittances, SH
    if info.label_names:
        floats_per_gaussian += 3 + 3 + 4 + 1 + 1  # the parts by label, of degree 0
    return int(_RESIDENT_PER_RAW_BYTE * 4 * floats_per_gaussian * info.gaussian_count)


@dataclass(frozen=True)
class FileVersion:
    """Tells one content of a file from the next, without reading it."""

    mtime_ns: int
    size: int
    inode: int

    @classmethod
    def of(cls, path: str | Path) -> FileVersion:
        status = os.stat(path)
        return cls(mtime_ns=status.st_mtime_ns, size=status.st_size, inode=status.st_ino)


class SceneStore:
    """The scenes of some folders: `NAME.ugr` is the scene NAME, in the first folder that has it.

    Files and folders may come, change and go at any time.
    """

    def __init__(self, *folders: Path) -> None:
        self.folders = tuple(Path(folder) for folder in folders)
        self._headers: dict[str, tuple[FileVersion, SceneHeader]] = {}

    def names(self) -> list[str]:
        """The names of all scenes, sorted; files whose name could not stand in a URL are left out."""
        return sorted({name for folder in self.folders for name in _names_in(folder)})

    def names_of(self, folder: Path) -> set[str]:
        """The names of the scenes that are those of one of the folders: none before it has the name."""
        before = self.folders[: self.folders.index(folder)]
        return set(_names_in(folder)).difference(*map(_names_in, before))

    def path(self, name: str) -> Path:
        """The file of a scene. Raises SceneNotFound, also for a name that no scene can have."""
        if _NAME.fullmatch(name) and (path := self.file(name)).is_file():
            return path
        raise self._not_found(name)

    def file(self, name: str) -> Path:
        """Where the file of a scene lies; in the first folder where there is none."""
        paths = [folder / f"{name}{SUFFIX}" for folder in self.folders]
        return next((path for path in paths if path.is_file()), paths[0])

    def header(self, name: str) -> SceneHeader:
        """A scene's description and training poses. Raises SceneNotFound, SceneFileInvalid."""
        path = self.path(name)
        try:
            version = FileVersion.of(path)  # before reading, so that a change meanwhile counts as newer
        except FileNotFoundError:
            raise self._not_found(name) from None
        except OSError as error:
            raise scene_file_invalid(path, error) from error
        cached = self._headers.get(name)
        if cached is not None and cached[0] == version:
            return cached[1]
        header = read_header(path)
        self._headers[name] = (version, header)
        return header

    def cached_header(self, name: str) -> SceneHeader | None:
        """The description if it was read before and the file is unchanged, at the cost of one stat."""
        cached = self._headers.get(name)
        if cached is None:
            return None
        try:
            return cached[1] if cached[0] == FileVersion.of(self.file(name)) else None
        except OSError:
            return None

    def _not_found(self, name: str) -> SceneNotFound:
        known = self.names()
        shown = ", ".join(known[:_NAMES_IN_MESSAGE]) + (", …" if len(known) > _NAMES_IN_MESSAGE else "")
        hint = f"known scenes: {shown}" if known else "there are no scenes yet"
        return SceneNotFound(f"there is no scene {name[:128]!r}; {hint}", field="scene")


def check_scene_name(name: Any) -> None:
    """Raises InvalidArgument for a name that no scene can have."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InvalidArgument(
            f"scene must be 1 to 128 letters, digits, '.', '_', '-', got {str(name)[:128]!r}",
            field="scene",
        )


def _names_in(folder: Path) -> list[str]:
    try:
        entries = list(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []
    return [
        entry.stem for entry in entries if entry.suffix == SUFFIX and _NAME.fullmatch(entry.stem) and entry.is_file()
    ]
