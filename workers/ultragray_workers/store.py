"""The artifact folder as a whole: the version of its layout, who has it open, and a restore that is under way.

store.json       {"format_version": 1}
store.lock       locked by all who have the folder open; a restore locks it alone
restoring.json   there from the first to the last change of a restore
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from ultragray.files import sync, write_whole
from ultragray_workers.errors import RestoreRefused, StartupFailed

FORMAT_VERSION = 1
_VERSION_FILE, _LOCK_FILE, MARKER = "store.json", "store.lock", "restoring.json"
PRIVATE_FOLDER, PRIVATE_FILE = 0o700, 0o600  # modes of what is made here: keys' hashes, and what people own
_READ_ONLY = (errno.EACCES, errno.EPERM, errno.EROFS)


class OpenStore:
    def __init__(self, folder: Path) -> None:
        """Raises StartupFailed for a folder of a newer release, and during a restore; OSError."""
        self._lock: IO[str] | None = None
        try:
            folder.mkdir(mode=PRIVATE_FOLDER, parents=True, exist_ok=True)
            self._lock = (folder / _LOCK_FILE).open("a")
            fcntl.flock(self._lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError as error:
            self.close()
            if isinstance(error, BlockingIOError):
                raise _being_restored(folder) from None
            if error.errno not in _READ_ONLY:  # of a service that only reads there
                raise
        try:
            if restore_under_way(folder) is not None:
                raise _being_restored(folder)
            _require_version(folder)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """The folder may be restored from now on."""
        if self._lock is not None:
            self._lock.close()


@contextlib.contextmanager
def closed_store(folder: Path) -> Iterator[None]:
    """Nobody opens the folder during the body. Raises RestoreRefused where somebody has it open."""
    with (folder / _LOCK_FILE).open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RestoreRefused(
                f"a service or a worker is at work in {folder}: stop all of them, on every host, first"
            ) from None
        yield


def restore_under_way(folder: Path) -> str | None:
    """The name of the backup whose restore has begun and not ended."""
    try:
        return str(json.loads((folder / MARKER).read_text(encoding="utf-8"))["backup"])
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError):
        return ""


def write_restore_marker(folder: Path, backup: str) -> None:
    write_whole(folder / MARKER, json.dumps({"backup": backup}) + "\n")


def remove_restore_marker(folder: Path) -> None:
    (folder / MARKER).unlink(missing_ok=True)
    sync(folder)


def _being_restored(folder: Path) -> StartupFailed:
    return StartupFailed(
        f"{folder} is being restored from a backup: wait for the end of `ultragray restore`, or start it again where "
        "it was interrupted",
        field="artifact_folder",
    )


def _require_version(folder: Path) -> None:
    """Writes the version where there is none. Raises StartupFailed for another one, and a damaged file."""
    path = folder / _VERSION_FILE
    try:
        version = int(json.loads(path.read_text(encoding="utf-8"))["format_version"])
    except FileNotFoundError:
        with contextlib.suppress(PermissionError):
            write_whole(path, json.dumps({"format_version": FORMAT_VERSION}) + "\n")
        return
    except (ValueError, KeyError, TypeError) as error:
        raise StartupFailed(f"{path} is damaged: restore the folder from a backup", field="artifact_folder") from error
    if version != FORMAT_VERSION:
        raise StartupFailed(
            f"{folder} has version {version} of the layout of artifact folders, and this release knows version "
            f"{FORMAT_VERSION}: another release has used it; start that one, or restore a backup that this one made",
            field="artifact_folder",
        )
