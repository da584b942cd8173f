"""Work of several messages or calls: batches of any length, uploads, and downloads that go on where they broke off."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Generic, TypeVar

from ultragray_client.connection import Retries, error_of_frame
from ultragray_client.contract import DatasetOptions, RecordingView
from ultragray_client.errors import ClientError, InvalidArgument, TooManyPoses, Unreachable
from ultragray_client.frames import Frame, RealFrame, frame_from_message
from ultragray_client.geometry import PoseLike, pose_messages
from ultragray_client.messages import ReceivedFrame, message_of
from ultragray_client.records import Job, JobEvent, job_from_message
from ultragray_proto.codec import from_message
from ultragray_proto.v1 import datasets_pb2, geometry_pb2, jobs_pb2, recordings_pb2, rendering_pb2

T = TypeVar("T")
_POSES_PER_CALL = 256  # halved where the service takes fewer


class Conversation(ABC, Generic[T]):
    """Calls whose answers are streams: where one breaks off, the next asks for what is missing."""

    @abstractmethod
    def request(self) -> Any:
        """The request of the next call; None when all is there."""

    @abstractmethod
    def take(self, message: Any) -> T:
        """The meaning of a message."""

    @abstractmethod
    def end_of_call(self) -> None:
        """Notes that the service ended a call without an error. Raises ClientError where it should have gone on."""

    def pause_s(self, error: ClientError, retries: Retries) -> float:
        """The seconds to wait before the next call. Raises the error where no other call can succeed."""
        return retries.pause_s(error)


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

    def take(self, message: ReceivedFrame) -> Frame:
        """The frame of the first pose that waits."""
        frame = frame_from_message(message, sequence=self._first)
        self._waiting.popleft()
        self._first += 1
        return frame

    def end_of_call(self) -> None:
        """A call brings no more than the frames of its own poses."""

    def pause_s(self, error: ClientError, retries: Retries) -> float:
        """The seconds to wait; asks for fewer poses at once where they were too many."""
        count = min(self._per_call, len(self._waiting))
        if isinstance(error, TooManyPoses) and count > 1:
            self._per_call = count // 2
            return 0.0
        return retries.pause_s(self._renumbered(error))

    def _renumbered(self, error: ClientError) -> ClientError:
        """The error with the index in the whole batch, where it names a pose of one call."""
        match = re.match(r"pose$|poses\[(\d+)\]", error.field or "")
        if match is None:
            return error
        # One that is found while frames come, in their order, is told as that of a single pose.
        index = self._first if match[1] is None else self._first_of_call + int(match[1])
        detail, field = (text.replace(match[0], f"poses[{index}]", 1) for text in (error.detail, error.field or ""))
        return type(error)(detail, reason=error.reason, field=field, retry_after_s=error.retry_after_s)


_CHUNK_BYTES = 2**20
_ARCHIVE_SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz")


@dataclass(frozen=True)
class RecordingAnswer:
    """How far a recording is, and why a frame is none of it."""

    recording: RecordingView
    error: ClientError | None  # with the number of the frame as its `sequence`


class Recorder(Conversation[RecordingAnswer]):
    """Real frames on their way into a recording: those that are not known to be stored are sent again.

    Messages are made in the thread of a call. That of a call which broke may still wait for the caller's next frame; it
    leaves that frame to the call after it.
    """

    def __init__(self, name: str, frames: Iterable[RealFrame]) -> None:
        self._name, self._frames = name, iter(frames)
        self._unstored: deque[recordings_pb2.IncomingFrame] = deque()
        self._next_number = 0
        self._has_ended = False  # the caller's frames
        self._call = 0  # its number
        self._is_answered = threading.Event()  # the call that is open; then the number of the next frame is known
        self._taking, self._changing = threading.Lock(), threading.Lock()

    def request(self) -> Iterator[recordings_pb2.RecordFramesRequest] | None:
        """The messages of the next call; None when all frames are stored."""
        if self._has_ended and not self._unstored:
            return None
        self._is_answered.clear()
        return self._messages(self._call)

    def take(self, message: recordings_pb2.RecordFramesResponse) -> RecordingAnswer:
        """How far the recording is, or why a frame is none of it."""
        recording, error = from_message(message.recording, RecordingView), None
        with self._changing:
            self._next_number = max(self._next_number, recording.next_number)
            while self._unstored and self._unstored[0].number < recording.next_number:
                self._unstored.popleft()
            if message.HasField("error"):
                number = message.refused_number if message.HasField("refused_number") else None
                error = error_of_frame(message.error, number)
                self._unstored = deque(one for one in self._unstored if one.number != number)
        self._is_answered.set()
        return RecordingAnswer(recording, error)

    def end_of_call(self) -> None:
        """Notes that the messages of the call are over."""
        self._call += 1
        self._is_answered.set()

    def pause_s(self, error: ClientError, retries: Retries) -> float:
        """The seconds to wait before the next call."""
        self.end_of_call()
        return super().pause_s(error, retries)

    def _messages(self, call: int) -> Iterator[recordings_pb2.RecordFramesRequest]:
        request, last_number = recordings_pb2.RecordFramesRequest, -1
        yield request(dataset=self._name)
        self._is_answered.wait()
        while call == self._call:
            with self._taking:
                with self._changing:
                    waiting = [frame for frame in self._unstored if frame.number > last_number]
                if not waiting and (frame := self._next()) is not None:
                    waiting = [frame]
            if not waiting:
                return
            for one in waiting:
                last_number = one.number
                yield request(frame=one)

    def _next(self) -> recordings_pb2.IncomingFrame | None:
        """The caller's next frame, with its number; None after the last one. Raises InvalidArgument, InvalidPose."""
        frame = None if self._has_ended else next(self._frames, None)
        if frame is None:
            self._has_ended = True
            return None
        message = frame.message()
        with self._changing:
            if frame.number is None:
                message.number = self._next_number
            self._next_number = max(self._next_number, message.number + 1)
            self._unstored.append(message)
        return message


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


class Watch(Conversation[JobEvent]):
    """The news of a job until its final state; each call begins with the last lines of the log."""

    def __init__(self, job_id: str) -> None:
        self._job_id = job_id
        self._over = False
        self._seen = ""  # the end of the log so far
        self._again = False  # the next lines may be seen ones

    def request(self) -> jobs_pb2.WatchJobRequest | None:
        return None if self._over else jobs_pb2.WatchJobRequest(job=self._job_id)

    def take(self, message: jobs_pb2.JobEvent) -> JobEvent:
        job = job_from_message(message.job) if message.HasField("job") else None
        return JobEvent(job, self._new(message.log))

    def end_of_call(self) -> None:
        self._over = True

    def pause_s(self, error: ClientError, retries: Retries) -> float:
        self._again = True
        return retries.pause_s(error)

    def _new(self, log: str) -> str:
        if self._again and log:
            self._again = False
            place = log.rfind(self._seen) if self._seen else -1
            log = log if place < 0 else log[place + len(self._seen) :]
        self._seen = (self._seen + log)[-1000:]
        return log


class LastJob(Watch):
    """A watch that keeps the last that was told of the job itself."""

    def __init__(self, job_id: str) -> None:
        super().__init__(job_id)
        self._job: Job | None = None

    @property
    def result(self) -> Job:
        """The job in its final state, once the watch is over."""
        assert self._job is not None  # the first event has it
        return self._job

    def keep(self, event: JobEvent) -> None:
        """Takes an event."""
        self._job = event.job or self._job


class Download(Conversation[jobs_pb2.ArtifactChunk]):
    """The part of a file that is there; each chunk goes to `keep` before the next one is asked for."""

    def __init__(self, job_id: str, name: str, descriptor: int) -> None:
        self._job_id, self._name = job_id, name
        self._descriptor = descriptor
        self._received = 0
        self._expected: int | None = None
        self.result = None  # the file itself is

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

    def keep(self, chunk: jobs_pb2.ArtifactChunk) -> None:
        """Writes a chunk to the disk. Raises OSError."""
        self._expected = chunk.file_bytes
        rest = memoryview(chunk.data)
        while rest:
            written = os.write(self._descriptor, rest)
            self._received += written
            rest = rest[written:]


@contextlib.contextmanager
def download_into(job_id: str, name: str, path: Path) -> Iterator[Download]:
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
