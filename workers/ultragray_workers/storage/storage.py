"""Objects by key, wherever they are: the methods that a folder and a bucket have in common.

Scenes, datasets and the files of jobs are objects; nothing above knows where they lie. `local` and `remote` are the two
implementations, `location` opens the one that a path or a URL names.

A key is a relative POSIX path such as `jobs/0c5f/outcome.json`. All methods block; call them in a thread.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from ultragray.errors import InvalidArgument

_MAX_KEY_BYTES = 1024  # of S3


class NotThere(LookupError):
    """There is no object of that key, or not the version that was asked for."""


class Damaged(Exception):
    """An object does not have the hash that it should have; the text is its path."""


@dataclass(frozen=True)
class Entry:
    """An object without its content."""

    key: str
    bytes: int
    version: str  # tells one content from the next: of a bucket the ETag, of a folder that of the file
    modified: float  # seconds since 1970


@dataclass(frozen=True)
class StorageUrl:
    """A bucket (of Azure, a container) of an object storage, and what the keys in it begin with; without credentials.

    `scheme` is s3, gs or az; `prefix` neither begins nor ends with a slash, and may be empty.
    """

    scheme: str
    bucket: str
    prefix: str = ""

    def __str__(self) -> str:
        return f"{self.scheme}://{self.bucket}/{self.prefix}".rstrip("/")

    def below(self, key: str) -> StorageUrl:
        """The place of the objects whose keys begin with `key` and a slash."""
        return StorageUrl(self.scheme, self.bucket, f"{self.prefix}/{key}".strip("/"))


class Storage(Protocol):
    """The objects of a folder or of a bucket. Its methods may be called from any thread.

    Every method raises StorageUnavailable where a bucket does not answer, or refuses: the same call may succeed later.
    Of a folder they raise the OSError of the file system. InvalidArgument: a key that no object can have.
    """

    @property
    def location(self) -> str:
        """Where it is, as a person wrote it, without credentials."""

    @property
    def is_near(self) -> bool:
        """Whether objects are files of this host, looked at in microseconds; `upload` takes a condition in one step."""

    def in_place(self, key: str) -> Path | None:
        """The file that an object is, there or not; None where objects must be downloaded."""

    def entries(self, prefix: str = "") -> Iterator[Entry]:
        """The objects below `prefix` (whole parts of a path: `jobs` has `jobs/a`, not `jobs2/a`), in any order."""

    def entries_in(self, prefix: str = "") -> Iterator[Entry]:
        """The objects directly below `prefix`: of `a/b` and `a/c/d`, below `a`, the first alone."""

    def entry(self, key: str) -> Entry | None:
        """One object without its content; None where it is absent."""

    def read(self, key: str, *, start: int = 0, length: int | None = None) -> bytes:
        """The content from byte `start` on, at most `length` bytes; what lies beyond the end is left out.

        Raises NotThere.
        """

    def write(self, key: str, data: bytes, *, if_absent: bool = False) -> bool:
        """Writes a small object, whole or not at all. False: `if_absent`, and there is one already.

        An object that holds exactly `data` counts as written, since an answer that was lost cannot be told from a
        success: where one writer must win, each puts something of its own into `data`.
        """

    def upload(self, path: Path, key: str, *, if_absent: bool = False) -> bool:
        """Writes an object from a file, which must not change later: a folder may keep a link to it.

        It appears whole or not at all. False: `if_absent`, and there is one (of a bucket, for a file over 16 MiB, as
        seen before the upload begins: give such objects keys that only one content can have).
        """

    def download(self, key: str, path: Path, *, version: str | None = None) -> Entry:
        """Writes an object to a file, which appears whole or not at all, and must not change: it may be a link.

        Raises NotThere, OSError of the file.
        """

    def delete(self, key: str) -> None:
        """Removes an object; nothing where it is absent."""

    def delete_all(self, prefix: str) -> None:
        """Removes the objects below `prefix`."""

    def delete_half_written(self, prefix: str) -> None:
        """Removes what killed writers left below `prefix`, where nobody writes any more."""

    def held(
        self, prefix: str, sha256: Mapping[str, str], folder: Path, max_bytes: int
    ) -> AbstractContextManager[Path]:
        """A folder of this host with objects below `prefix`, which never change, during the body: in place, or a copy.

        `sha256`: of each, by its path below the prefix. `folder`: for copies, which take at most `max_bytes` beside
        those in use. Raises NotThere where one is gone, Damaged for one of another hash.
        """

    def claimed(self, token: str) -> AbstractContextManager[None]:
        """Lets all who have the storage find the token claimed during the body, as long as this process lives.

        Enter and leave it in any threads.
        """

    def is_claimed(self, token: str) -> bool:
        """Whether a process that lives, on any host, has claimed the token."""

    def free_bytes(self) -> int | None:
        """The room that is left; None where nobody knows."""


def check_key(key: str) -> str:
    """The key itself. Raises InvalidArgument for one that could leave the storage, or that a bucket would change."""
    parts = key.split("/")
    if any(part in ("", ".", "..") for part in parts) or "\0" in key or len(key.encode()) > _MAX_KEY_BYTES:
        raise InvalidArgument(f"a key must be a relative path of at most {_MAX_KEY_BYTES} bytes, got {key[:128]!r}")
    return key
