"""Folders in which something is made whole before it gets its place; those of services that died are found and removed.

A claimed folder holds the file `lock`, locked as long as its maker lives. Free of torch.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import secrets
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from ultragray_workers.errors import StorageFull

LOCK_NAME = "lock"
DELETED_PREFIX = ".deleted-"
UNLOCKED_S = 60.0  # a folder without a lock that was made or renamed this lately is about to get one, or to go


@contextlib.contextmanager
def claimed_folder(parent: Path, prefix: str) -> Iterator[Path]:
    """A new folder of ours in `parent`; what is left in it goes at the end. Enter and leave it in any threads."""
    parent.mkdir(parents=True, exist_ok=True)
    folder = parent / f"{prefix}{secrets.token_hex(8)}"
    folder.mkdir()
    try:
        with (folder / f"{LOCK_NAME}.new").open("wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            (folder / f"{LOCK_NAME}.new").rename(folder / LOCK_NAME)  # nobody finds it unlocked
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def remove_whole(folder: Path, prefix: str = DELETED_PREFIX) -> None:
    """Remove a folder: to others it goes at once, under another name with the prefix. Nothing where it is gone."""
    doomed = folder.with_name(f"{prefix}{secrets.token_hex(8)}")
    with contextlib.suppress(FileNotFoundError):
        folder.rename(doomed)
        shutil.rmtree(doomed, ignore_errors=True)


def remove_abandoned(parent: Path, prefix: str) -> int:
    """Remove the folders of a prefix that no living service, on any machine, holds; how many there were."""
    abandoned = [folder for folder in parent.glob(f"{prefix}*") if _is_abandoned(folder)]
    for folder in abandoned:
        shutil.rmtree(folder, ignore_errors=True)
    return len(abandoned)


def _is_abandoned(folder: Path) -> bool:
    try:
        with (folder / LOCK_NAME).open("rb+") as lock:
            return try_lock(lock)
    except FileNotFoundError:
        with contextlib.suppress(FileNotFoundError):
            return time.time() - folder.stat().st_ctime > UNLOCKED_S
    except OSError:
        pass
    return False


def age_s(path: Path) -> float:
    """The seconds since a file or folder was changed; 0 where it is gone."""
    try:
        return time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def try_lock(file: IO[Any]) -> bool:
    """Whether the file is locked by us alone now, until it is closed here and in all processes that inherited it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def is_no_room(error: OSError) -> bool:
    """Whether a disk, or the share of it that one may use, is full."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextlib.contextmanager
def storage_full(what: str) -> Iterator[None]:
    """Raise StorageFull where a disk has no room."""
    try:
        yield
    except OSError as error:
        if is_no_room(error):
            raise StorageFull(f"the artifact folder has no room for {what}") from error
        raise
