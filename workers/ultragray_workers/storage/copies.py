"""Folders of objects of a bucket, copied to this host: made whole, kept while they are used, the oldest removed.

NAME/content/   what was fetched
NAME/lock       locked together by those who use the copy, alone by who removes it
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from ultragray.files import sync
from ultragray_workers.claims import LOCK_NAME, claimed_folder, remove_abandoned

FOLDER = ".copies"
_PREFIX, _CONTENT = ".fetching-", "content"
DEFAULT_MAX_BYTES = 20 * 2**30


class LocalCopies:
    """The copies below a folder, which the processes of one host share."""

    def __init__(self, folder: Path, max_bytes: int = DEFAULT_MAX_BYTES) -> None:
        """`max_bytes`: of all copies; those in use may take more."""
        self._folder = folder / FOLDER
        self._max_bytes = max_bytes

    @contextlib.contextmanager
    def held(self, name: str, fetch: Callable[[Path], None]) -> Iterator[Path]:
        """The copy of that name, made by `fetch` in an empty folder where it is not there; it stays during the body.

        Raises what `fetch` raises, OSError.
        """
        while (lock := self._take(name)) is None:
            self._make(name, fetch)
        with lock:
            yield self._folder / name / _CONTENT

    def _take(self, name: str) -> contextlib.ExitStack | None:
        """A hold on the copy, which then counts as the one used last; None where it is not there."""
        with contextlib.ExitStack() as stack:
            try:
                lock = stack.enter_context((self._folder / name / LOCK_NAME).open("rb"))
                fcntl.flock(lock, fcntl.LOCK_SH)
                os.utime(self._folder / name / _CONTENT)  # it may have been removed while this waited
            except FileNotFoundError:
                return None
            return stack.pop_all()

    def _make(self, name: str, fetch: Callable[[Path], None]) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        remove_abandoned(self._folder, _PREFIX)
        with claimed_folder(self._folder, _PREFIX) as making:
            copy = making / "copy"
            (copy / _CONTENT).mkdir(parents=True)
            (copy / LOCK_NAME).touch()
            fetch(copy / _CONTENT)
            with contextlib.suppress(OSError):  # another process was quicker
                copy.rename(self._folder / name)
        sync(self._folder)
        self._make_room(name)

    def _make_room(self, newest: str) -> None:
        """Removes the copies that were used longest ago, and that nobody uses."""
        copies = [path for path in self._folder.iterdir() if not path.name.startswith(".")]
        held_bytes = 0
        for copy in sorted(copies, key=_used_at_s, reverse=True):
            held_bytes += _size_bytes(copy)
            if copy.name == newest or held_bytes <= self._max_bytes:
                continue
            with contextlib.suppress(OSError), (copy / LOCK_NAME).open("rb") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(copy / _CONTENT, ignore_errors=True)
                shutil.rmtree(copy, ignore_errors=True)


def _used_at_s(copy: Path) -> float:
    try:
        return (copy / _CONTENT).stat().st_mtime
    except FileNotFoundError:
        return 0.0


def _size_bytes(folder: Path) -> int:
    size = 0
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):
            size += path.stat().st_size
    return size
