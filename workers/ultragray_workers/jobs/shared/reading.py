"""The objects of a shared storage that services read of jobs: files in ranges, and the log as one. Free of torch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from ...storage.storage import NotThere, Storage
from .record import StoredFile, read_record

_CHUNK_BYTES = 2**22  # of one request


@dataclass(frozen=True)
class SharedFile:
    """A whole object to download."""

    storage: Storage
    name: str
    stored: StoredFile

    @property
    def bytes(self) -> int:
        """Its length."""
        return self.stored.bytes

    def chunks(self, start: int, end: int) -> Iterator[bytes]:
        """The bytes from `start` to before `end`. Raises StorageUnavailable, and NotThere where it was removed."""
        while start < end:
            chunk = self.storage.read(self.stored.key, start=start, length=min(_CHUNK_BYTES, end - start))
            if not chunk:
                raise NotThere(f"{self.stored.key} is shorter than it was")
            yield chunk
            start += len(chunk)


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
