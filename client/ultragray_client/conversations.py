"""Work of several messages or calls: batches of any length, uploads, and downloads that go on where they broke off."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
from collections import deque
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

from ultragray_client.connection import Conversation, Retries
from ultragray_client.contract import DatasetOptions
from ultragray_client.errors import ClientError, InvalidArgument, TooManyPoses, Unreachable
from ultragray_client.frames import Frame, frame_from_message
from ultragray_client.geometry import PoseLike, pose_messages
from ultragray_client.messages import message_of
from ultragray_proto.v1 import datasets_pb2, geometry_pb2, jobs_pb2, rendering_pb2

_POSES_PER_CALL = 256  # halved where the service takes fewer


class Batch(Conversation[Frame]):
    """The poses that wait for their frames."""

    def __init__(self, settings: rendering_pb2.RenderSettings, poses: Iterable[PoseLike]) -> None:
        self._settings = settings
        self._poses = pose_messages(poses)
        self._waiting: deque[geometry_pb2.Pose] = deque()
        self._first = 0  # sequence of the first that waits
        self._first_of_call = 0
        self._per_call = _POSES_PER_CALL

    def request(self) -> rendering_pb2.RenderBatchRequest | None:
        """The request for the next poses. Raises InvalidPose."""
        self._waiting.extend(islice(self._poses, max(self._per_call - len(self._waiting), 0)))
        if not self._waiting:
            return None
        self._first_of_call = self._first
        poses = islice(self._waiting, self._per_call)
        return rendering_pb2.RenderBatchRequest(settings=self._settings, poses=poses)

    def take(self, message: rendering_pb2.Frame) -> Frame:
        """The frame of the first pose that waits."""
        frame = frame_from_message(message, sequence=self._first)
        self._waiting.popleft()
        self._first += 1
        return frame

    def end_of_call(self) -> None:
        """A call brings no more than the frames of its own poses."""

    def pause_s(self, error: ClientError, retries: Retries) -> float:
        """The seconds to wait; asks for fewer poses at once where they were too many."""
        asked = min(self._per_call, len(self._waiting))
        if isinstance(error, TooManyPoses) and asked > 1:
            self._per_call = asked // 2
            return 0.0
        return retries.pause_s(self._renumbered(error))

    def _renumbered(self, error: ClientError) -> ClientError:
        """The error with the index in the whole batch, where it names a pose of one call."""
        named = re.match(r"pose$|poses\[(\d+)\]", error.field or "")
        if named is None:
            return error
        # One that is found while frames come, in their order, is told as that of a single pose.
        index = self._first if named[1] is None else self._first_of_call + int(named[1])
        detail, field = (text.replace(named[0], f"poses[{index}]", 1) for text in (error.detail, error.field or ""))
        return type(error)(detail, reason=error.reason, field=field, retry_after_s=error.retry_after_s)


# The messages of an upload.


_CHUNK_BYTES = 2**20
_ARCHIVE_SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz")


class Upload:
    """A folder with all below it, or one archive (.zip, .tar, .tar.gz, .tgz), on its way to the service."""

    def __init__(self, name: str, path: str | Path, options: DatasetOptions, private: bool) -> None:
        """Raises InvalidArgument for a path that is neither."""
        self._name, self._path, self._options, self._private = name, Path(path), options, private
        if not self._path.is_dir() and not (self._path.is_file() and self._path.name.endswith(_ARCHIVE_SUFFIXES)):
            expected = f"a folder or an archive ({', '.join(_ARCHIVE_SUFFIXES)})"
            raise InvalidArgument(f"path must be {expected} that exists, got {self._path}", field="path")

    def messages(self) -> Iterator[datasets_pb2.UploadDatasetRequest]:
        """The header, then the files in chunks of 1 MiB. Raises OSError."""
        request = datasets_pb2.UploadDatasetRequest
        options = message_of(self._options, datasets_pb2.DatasetOptions)
        archive = self._path.is_file()
        header = datasets_pb2.UploadHeader(dataset=self._name, options=options, archive=archive, private=self._private)
        yield request(header=header)
        for path in [self._path] if archive else sorted(self._path.rglob("*")):
            if not path.is_file():
                continue
            if not archive:
                yield request(file=path.relative_to(self._path).as_posix())
            with path.open("rb") as file:
                while chunk := file.read(_CHUNK_BYTES):
                    yield request(chunk=chunk)


# A file that comes in chunks: whole under its name, or not at all.


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
