"""Files written whole or not at all, linked, checked for their version, and mapped. Beneath all that reads or writes
one.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import hashlib
import io
import math
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from tokenize import TokenError
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

TEMPORARY_SUFFIX = ".tmp"
_SYNC_BYTES = 64 * 2**20
_OF_WRITING = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path`; on success it is synced and renamed to `path`, on failure removed."""
    path = Path(path)
    # Named before it is made: a signal that comes between the two leaves nothing.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}{TEMPORARY_SUFFIX}")
    try:
        temporary.touch(mode=0o600, exist_ok=False)
        yield temporary
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        sync(temporary)
        temporary.replace(path)
        sync(path.parent)
    except OSError as error:
        if not _is_about_temporary(error, path):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error  # the caller knows of no other file
    finally:
        with contextlib.suppress(NotADirectoryError):
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
    for file in path.parent.glob(f"{glob.escape(prefix)}*{TEMPORARY_SUFFIX}"):
        if "." not in file.name.removeprefix(prefix).removesuffix(TEMPORARY_SUFFIX):  # else another file's
            file.unlink(missing_ok=True)


def write_whole(path: str | Path, content: str | bytes) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def npy_bytes(array: Any) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return file.getvalue()


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


def file_sha256(path: str | Path) -> str:
    """The hash that names a scene in every frame rendered from it: SHA-256 of its file, hexadecimal."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


class StreamedFile:
    """A file that is written from its beginning to its end, and on the way hashed and brought to the disk.

    Whoever syncs it at the end then waits for its last part alone. What is on the disk leaves the memory: a large file
    pushes nothing else out of it, and in a virtual machine, to which the host gives every new page, writing takes a
    fifth of the time. What seeks in files finds that it cannot.
    """

    def __init__(self, path: Path) -> None:
        """Raises OSError."""
        self._file = path.open("wb")
        self._digest = hashlib.sha256()
        self._bytes = self._synced = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()

    def write(self, data: bytes | memoryview) -> int:
        """The number of bytes, all of which are written. Raises OSError."""
        content = memoryview(data).cast("B")
        self._file.write(content)
        self._digest.update(content)
        self._bytes += len(content)
        if self._bytes - self._synced >= _SYNC_BYTES:
            self._file.flush()
            descriptor = self._file.fileno()
            os.fdatasync(descriptor)
            os.posix_fadvise(descriptor, self._synced, self._bytes - self._synced, os.POSIX_FADV_DONTNEED)
            self._synced = self._bytes
        return len(content)

    def tell(self) -> int:
        return self._bytes

    def flush(self) -> None:
        self._file.flush()

    @property
    def sha256(self) -> str:
        """Hexadecimal, of what has been written so far."""
        return self._digest.hexdigest()


def link_or_copy(source: Path, target: Path) -> None:
    """Makes `target` the same file as `source`, or a whole copy where that cannot be; an existing target stays.

    What is there then survives a loss of power. Raises OSError.
    """
    with contextlib.suppress(FileExistsError):
        try:
            os.link(source.resolve(), target)
        except FileExistsError:
            raise
        except OSError:  # another file system, or one without links
            _copy(source, target)
    sync(target.parent)


def _copy(source: Path, target: Path) -> None:
    with atomic_path(target) as temporary:
        shutil.copyfile(source, temporary)
        sync(temporary)
        try:
            os.link(temporary, target)  # unlike a rename, never over what appeared meanwhile
        except FileExistsError:
            raise
        except OSError:
            if target.exists():
                raise FileExistsError from None


def require_version(version: Any, known: int) -> None:
    """Raises ValueError where a file is of another version than the release reads."""
    if type(version) is int and version > known:
        raise ValueError(
            f"its format_version is {version}, this release reads {known}: a newer release wrote it, use that one or a "
            "newer one to read it"
        )
    if type(version) is not int or version != known:
        raise ValueError(f"its format_version is {version!r}, this release reads {known}")


# One array of numbers in a `.npy` file, mapped and not read; what is wrong with a file, in our words.
#
# The header is checked before numpy maps the file: its own messages advise to unpickle what is no array.

_DAMAGED = "its .npy header is damaged or truncated"
_MAGIC, _ZIP_MAGIC = b"\x93NUMPY", b"PK\x03\x04"


def map_npy(path: Path) -> npt.NDArray[Any]:
    """The array of a `.npy` file as a read-only mapping, which cannot be larger than its file.

    Raises ValueError with the reason as a clause: no `.npy` file, an archive, truncated, or of Python objects. Raises
    OSError where the file cannot be read. Never runs code from the file.
    """
    with path.open("rb") as file:
        shape, dtype = _read_header(file)
        missing = file.tell() + math.prod(shape) * dtype.itemsize - path.stat().st_size
    if missing > 0:
        raise ValueError(f"it is truncated: {missing} bytes are missing")
    try:
        return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))
    except OverflowError:
        raise ValueError(_DAMAGED) from None  # sizes that no array has, one of them 0


def _read_header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    start = file.read(len(_MAGIC))
    if start.startswith(_ZIP_MAGIC):
        raise ValueError("it is an archive (.npz), where one array (.npy) is expected")
    if start != _MAGIC:
        raise ValueError("it does not start as a .npy file does")
    file.seek(0)
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
    except (ValueError, TypeError, SyntaxError, TokenError, RecursionError):
        raise ValueError(_DAMAGED) from None
    if dtype.hasobject:
        raise ValueError("it holds Python objects, where numbers are expected")
    if any(size < 0 for size in shape):
        raise ValueError(_DAMAGED)
    return shape, dtype
