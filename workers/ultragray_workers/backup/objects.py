"""The files of backups by their content: each is kept once, under its SHA-256, whatever its names are."""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ultragray.files import file_sha256, sync
from ultragray_workers.storage.local import FileVersion

FOLDER = "objects"
_INCOMING = ".incoming-"
_NAME = re.compile(r"[0-9a-f]{64}")
_BLOCK_BYTES = 2**20
_ATTEMPTS = 5  # to read a file that somebody rewrites in its place


@dataclass(frozen=True)
class Stored:
    sha256: str
    bytes: int
    version: FileVersion
    is_new: bool  # no earlier file had this content


class Objects:
    """The contents in a backup folder. One process at a time adds and removes them."""

    def __init__(self, backup_folder: Path) -> None:
        self.folder = backup_folder / FOLDER

    def path(self, sha256: str) -> Path:
        """The place of a content, also of one that is not there."""
        return self.folder / sha256[:2] / sha256

    def has(self, sha256: str) -> bool:
        return self.path(sha256).is_file()

    def is_whole(self, sha256: str) -> bool:
        return self.has(sha256) and file_sha256(self.path(sha256)) == sha256

    def add(self, source: Path, *, grows: bool = False) -> Stored:
        """Keeps a copy of a file; one that `grows` is taken up to the length that it has at first. Raises OSError.

        A file that is replaced meanwhile is kept as it was at first, one that is rewritten in its place is read again.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        for _ in range(_ATTEMPTS):
            with source.open("rb") as file:
                before = FileVersion.of(file.fileno())
                descriptor, name = tempfile.mkstemp(dir=self.folder, prefix=_INCOMING)
                incoming = Path(name)
                try:
                    digest = hashlib.sha256()
                    left = before.size
                    with os.fdopen(descriptor, "wb") as copy:
                        while left and (block := file.read(min(_BLOCK_BYTES, left))):
                            digest.update(block)
                            copy.write(block)
                            left -= len(block)
                    if not left and (grows or FileVersion.of(file.fileno()) == before):
                        return self._keep(incoming, digest.hexdigest(), before)
                finally:
                    incoming.unlink(missing_ok=True)
        raise OSError(f"{source} changes all the time: it could not be copied as it was at one moment")

    def _keep(self, incoming: Path, sha256: str, version: FileVersion) -> Stored:
        target = self.path(sha256)
        is_new = not target.is_file()
        if is_new:
            target.parent.mkdir(exist_ok=True)
            sync(incoming)
            incoming.rename(target)
            sync(target.parent)
        return Stored(sha256, version.size, version, is_new)

    def remove_all_but(self, kept: set[str]) -> tuple[int, int]:
        """Removes the contents that no backup has any more, and half written ones; their number and bytes."""
        count = size = 0
        for path in self._files():
            if path.name not in kept:
                count, size = count + 1, size + path.stat().st_size
                path.unlink()
        return count, size

    def remove_leftovers(self) -> None:
        for path in self.folder.glob(f"{_INCOMING}*"):
            path.unlink()

    def _files(self) -> Iterator[Path]:
        for path in self.folder.glob("??/*"):
            if _NAME.fullmatch(path.name):
                yield path
