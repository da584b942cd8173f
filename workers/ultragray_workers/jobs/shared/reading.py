"""The files of jobs that services read, piece by piece, wherever they are. Free of torch."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from ultragray_workers.jobs.shared.record import StoredFile, read_record
from ultragray_workers.storage.storage import Storage


@dataclass(frozen=True)
class SharedFile:
    """A whole object of a storage, to download."""

    storage: Storage
    name: str
    stored: StoredFile


@dataclass(frozen=True)
class OpenFile:
    """A file whose bytes can be read from any place."""

    length: int  # bytes
    source: IO[bytes] | SharedFile

    def read(self, start: int, length: int) -> bytes:
        """At most `length` bytes from `start` on; none at the end. Raises OSError, StorageUnavailable, NotThere."""
        if isinstance(self.source, SharedFile):
            return self.source.storage.read(self.source.stored.key, start=start, length=length)
        return os.pread(self.source.fileno(), length, start)


@contextlib.contextmanager
def opened(file: Path | SharedFile) -> Iterator[OpenFile]:
    """The file, open during the body. Raises OSError."""
    if isinstance(file, SharedFile):
        yield OpenFile(file.stored.bytes, file)
        return
    with file.open("rb") as source:
        yield OpenFile(os.fstat(source.fileno()).st_size, source)


@dataclass(frozen=True)
class SharedLog:
    """The log of a job, whose pieces the workers that had the job have written. Methods raise StorageUnavailable."""

    storage: Storage
    job_id: str

    def size(self) -> int:
        """The bytes that there are now."""
        record = read_record(self.storage, self.job_id)
        return 0 if record is None else record.log_bytes

    def read(self, start: int, length: int) -> bytes:
        """At most `length` bytes from `start` on."""
        record = read_record(self.storage, self.job_id)
        found, begin, end = [], 0, start + length
        for piece in () if record is None else record.log:
            first, last = max(start, begin), min(end, begin + piece.bytes)
            if first < last:
                found.append(self.storage.read(piece.key, start=first - begin, length=last - first))
            begin += piece.bytes
        return b"".join(found)
