"""A file that comes in chunks: whole under its name, or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from ultragray_proto.v1 import jobs_pb2

from ..errors import Unreachable
from .connection import Conversation


class Download(Conversation[jobs_pb2.ArtifactChunk]):
    """The part of a file that is there; each chunk goes to `write` before the next one is asked for."""

    def __init__(self, job_id: str, name: str, descriptor: int) -> None:
        self._job_id, self._name = job_id, name
        self._descriptor = descriptor
        self._received = 0
        self._expected: int | None = None

    def request(self) -> jobs_pb2.DownloadArtifactRequest | None:
        """The request for the part that is missing."""
        if self._received == self._expected:
            return None
        return jobs_pb2.DownloadArtifactRequest(job=self._job_id, name=self._name, offset=self._received)

    def take(self, message: jobs_pb2.ArtifactChunk) -> jobs_pb2.ArtifactChunk:
        return message

    def end_of_call(self) -> None:
        """Raises Unreachable where bytes are missing."""
        if self._received != self._expected:
            raise Unreachable(f"{self._name} of job {self._job_id} broke off after {self._received} bytes")

    def write(self, chunk: jobs_pb2.ArtifactChunk) -> None:
        """Raises OSError."""
        self._expected = chunk.file_bytes
        rest = memoryview(chunk.data)
        while rest:
            written = os.write(self._descriptor, rest)
            self._received += written
            rest = rest[written:]


@contextlib.contextmanager
def downloaded(job_id: str, name: str, path: Path) -> Iterator[Download]:
    """A download into a temporary file beside `path`, which takes that name when the body is done. Raises OSError."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.tmp")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        try:
            yield Download(job_id, name, descriptor)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
