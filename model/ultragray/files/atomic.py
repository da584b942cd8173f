"""Files that are either complete or absent, and the hash that names them."""

from __future__ import annotations

import contextlib
import errno
import glob
import hashlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

TEMPORARY_SUFFIX = ".tmp"
_OF_WRITING = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path`; on success it is synced and renamed to `path`, on failure removed."""
    path = Path(path)
    temporary: Path | None = None
    try:
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=TEMPORARY_SUFFIX)
        os.close(descriptor)
        temporary = Path(name)
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        sync(temporary)
        temporary.replace(path)
        sync(path.parent)
    except OSError as error:
        if not _is_about_temporary(error, path):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error  # the caller knows of no other file
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def _is_about_temporary(error: OSError, path: Path) -> bool:
    """Whether an error names the temporary file of `path`, or is one of writing that names no file."""
    if error.filename is None:
        return error.errno in _OF_WRITING
    named = Path(os.fsdecode(error.filename))
    return named.parent == path.parent and named.name.startswith(f".{path.name}.")


def remove_stale_temporaries(path: str | Path) -> None:
    """Removes what processes killed inside `atomic_path(path)` left; nobody may be writing `path` meanwhile."""
    path = Path(path)
    prefix = f".{path.name}."
    for found in path.parent.glob(f"{glob.escape(prefix)}*{TEMPORARY_SUFFIX}"):
        if "." not in found.name.removeprefix(prefix).removesuffix(TEMPORARY_SUFFIX):  # else another file's
            found.unlink(missing_ok=True)


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write a file of this content (text as UTF-8), or leave what was there."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def sync(path: Path) -> None:
    """Make a file, or the names in a folder, survive a loss of power; folders where their file system can."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError:
        if not path.is_dir():
            raise
    finally:
        os.close(descriptor)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def file_sha256(path: str | Path) -> str:
    """The hash that names a scene in every frame rendered from it: SHA-256 of its file, hexadecimal."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
