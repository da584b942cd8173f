"""Jobs, as the service tells them, and what watches them."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, get_args

from ultragray_proto.codec import from_message
from ultragray_proto.v1 import jobs_pb2

from .calls.connection import Conversation
from .calls.retries import Retries
from .contract import Specification
from .errors import ClientError
from .geometry import pose_messages
from .messages import message_of

_KINDS: dict[str, Any] = {cls.kind: cls for cls in get_args(Specification)}


class JobState(str, Enum):
    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def final(self) -> bool:
        return self not in (JobState.QUEUED, JobState.RUNNING)


@dataclass(frozen=True)
class JobProgress:
    """Progress of a job; None: does not apply, or not yet."""

    step: int | None
    steps: int | None
    loss: float | None
    val_psnr_db: float | None  # on the held-out frames, the last time it was measured
    gaussians: int | None
    frames_done: int | None
    frames: int | None
    rate_per_s: float | None  # steps or frames
    seconds_left: float | None  # until the end of the job, about
    waits_for: str | None  # of a job that waits: what else it needs than its turn, such as a worker that fits it
    method: str | None  # of a comparison: the method at hand
    method_number: int | None  # its number among the methods, from 1
    methods: int | None
    phase: str | None  # of a training that runs: baselines, effort, training, evaluation, confidence or report


@dataclass(frozen=True)
class JobError:
    """The reason of a failed job."""

    reason: str  # stable
    detail: str  # one sentence


@dataclass(frozen=True)
class Job:
    """Work that the service does in the background. Times are ISO 8601, UTC; None: not yet."""

    id: str
    kind: str  # that of its specification
    state: JobState
    request_id: str
    specification: Specification  # as it was asked for, but for the poses
    pose_count: int  # how many of those there were
    priority: int
    created_at: str
    started_at: str | None
    finished_at: str | None
    error: JobError | None
    progress: JobProgress
    artifacts: tuple[str, ...]  # names of the files to download
    metrics: Mapping[str, float]  # of a trained scene on the held-out frames
    worker: str | None
    retry_of: str | None  # the job that this one goes on from
    attempts: int  # how often it was started
    owner: str | None  # who submitted it
    private: bool  # others do not see it


@dataclass(frozen=True)
class JobEvent:
    """News of a job."""

    job: Job | None  # where it changed
    log: str  # new lines


@dataclass(frozen=True)
class JobFilter:
    """The jobs to list; None: all."""

    state: JobState | str | None
    kind: str | None


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


def submission(
    specification: Specification, request_id: str | None, priority: int, private: bool
) -> jobs_pb2.SubmitJobRequest:
    """The request for a job. With an id of its own a submission that is sent again gives the same job.

    Raises InvalidPose, and InvalidArgument for a word that is none; the service checks the rest.
    """
    request_id = uuid.uuid4().hex if request_id is None else request_id
    request = jobs_pb2.SubmitJobRequest(request_id=request_id, priority=priority, private=private)
    job = getattr(request, specification.kind)
    poses = getattr(specification, "poses", None)
    others = {} if poses is None else {"poses": pose_messages(poses)}
    job.MergeFrom(message_of(specification, type(job), **others))
    job.SetInParent()
    return request


def job_from_message(message: jobs_pb2.Job) -> Job:
    """A job as the service tells it."""
    kind = message.WhichOneof("specification")
    cls = _KINDS[kind]
    others = {"poses": None} if hasattr(cls, "poses") else {}
    specification = from_message(getattr(message, kind), cls, **others)
    return from_message(message, Job, specification=specification, pose_count=message.render.pose_count)
