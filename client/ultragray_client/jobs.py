"""Jobs as values, and what can be asked about them."""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from enum import Enum
from typing import Any

from google.protobuf.json_format import MessageToDict, ParseDict, ParseError

from ultragray_proto.v1 import jobs_pb2

from .connection import Conversation, Operation
from .errors import ClientError, InvalidArgument
from .frames import output_names, output_numbers
from .geometry import PoseLike, pose_message
from .retries import Retries


class JobKind(str, Enum):
    TRAIN = "train"
    RENDER = "render"


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
    """How far a job is; None is what does not apply, or not yet."""

    step: int | None
    steps: int | None
    loss: float | None
    val_psnr_db: float | None  # on the held-out frames, the last time it was measured
    gaussians: int | None
    frames_done: int | None
    frames: int | None
    rate_per_s: float | None  # steps or frames
    seconds_left: float | None
    waits_for: str | None  # the device, while another job of the same host is at work on it


@dataclass(frozen=True)
class JobError:
    """Why a job failed."""

    reason: str  # stable
    detail: str  # one sentence


@dataclass(frozen=True)
class Job:
    """A training or a batch of frames. Times are ISO 8601, UTC; None: not yet."""

    id: str
    kind: JobKind
    state: JobState
    request_id: str
    specification: Mapping[str, Any]  # as it was asked for; of the poses only `pose_count`
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


@dataclass(frozen=True)
class JobEvent:
    """News of a job."""

    job: Job | None  # where it changed
    log: str  # new lines


class Watch(Conversation[JobEvent]):
    """The news of a job until its final state; each call begins with the last lines of the log."""

    method = "jobs.WatchJob"

    def __init__(self, job_id: str) -> None:
        self._job_id = job_id
        self._over = False
        self._seen = ""  # the end of the log so far
        self._again = False  # the next lines may be seen ones

    def request(self) -> jobs_pb2.WatchJobRequest | None:
        return None if self._over else jobs_pb2.WatchJobRequest(job=self._job_id)

    def take(self, message: jobs_pb2.JobEvent) -> JobEvent:
        return JobEvent(job_from_message(message.job) if message.HasField("job") else None, self._new(message.log))

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


def submit_train(
    dataset: str,
    scene: str,
    *,
    preset: str,
    settings: Mapping[str, Any] | None,
    device: str,
    request_id: str | None,
    priority: int,
) -> Operation[Job]:
    job = jobs_pb2.TrainJob(dataset=dataset, scene=scene, preset=preset, device=device)
    job.settings.update(settings or {})
    return _submit(jobs_pb2.SubmitJobRequest(train=job, request_id=_chosen(request_id), priority=priority))


def submit_render(
    scene: str,
    *,
    poses: Iterable[PoseLike] | None,
    sampler: Mapping[str, Any] | None,
    height: int | None,
    width: int | None,
    outputs: Sequence[str],
    archive_format: str,
    dtype: str,
    min_confidence: float | None,
    request_id: str | None,
    priority: int,
) -> Operation[Job]:
    """Raises InvalidPose, UnknownOutput, and InvalidArgument for a sampler's field that does not exist."""
    job = jobs_pb2.RenderJob(
        scene=scene,
        poses=[
            pose_message(pose, field=f"poses[{index}]") for index, pose in enumerate(() if poses is None else poses)
        ],
        height=height,
        width=width,
        outputs=output_numbers(outputs),
        format=archive_format,
        dtype=dtype,
        min_confidence=min_confidence,
    )
    if sampler is not None:
        try:
            ParseDict(dict(sampler), job.sampler)
        except ParseError as error:
            raise InvalidArgument(f"sampler {dict(sampler)} cannot be read: {error}", field="sampler") from None
    return _submit(jobs_pb2.SubmitJobRequest(render=job, request_id=_chosen(request_id), priority=priority))


def list_jobs(
    state: JobState | str | None, kind: JobKind | str | None, page_size: int, page_token: str
) -> Operation[tuple[list[Job], str]]:
    """Raises InvalidArgument for a state or kind that does not exist."""
    try:
        state_name = "UNSPECIFIED" if state is None else JobState(state).name
        kind_name = "UNSPECIFIED" if kind is None else JobKind(kind).name
    except ValueError as error:
        raise InvalidArgument(f"state and kind must be one of their enums, got {error}", field="state") from None
    request = jobs_pb2.ListJobsRequest(
        state=f"JOB_STATE_{state_name}", kind=f"JOB_KIND_{kind_name}", page_size=page_size, page_token=page_token
    )
    return Operation(
        "jobs.ListJobs",
        request,
        lambda answer: ([job_from_message(job) for job in answer.jobs], answer.next_page_token),
    )


def get_job(job_id: str) -> Operation[Job]:
    return Operation("jobs.GetJob", jobs_pb2.GetJobRequest(job=job_id), job_from_message)


def cancel_job(job_id: str) -> Operation[Job]:
    return Operation("jobs.CancelJob", jobs_pb2.CancelJobRequest(job=job_id), job_from_message)


def retry_job(job_id: str) -> Operation[Job]:
    return Operation("jobs.RetryJob", jobs_pb2.RetryJobRequest(job=job_id), job_from_message)


def delete_job(job_id: str) -> Operation[None]:
    return Operation("jobs.DeleteJob", jobs_pb2.DeleteJobRequest(job=job_id), lambda answer: None, deletes=True)


def job_log(job_id: str, max_bytes: int) -> Operation[str]:
    request = jobs_pb2.GetJobLogRequest(job=job_id, max_bytes=max_bytes)
    return Operation("jobs.GetJobLog", request, lambda answer: str(answer.log))


def job_from_message(message: jobs_pb2.Job) -> Job:
    progress = message.progress
    names = [field.name for field in fields(JobProgress)]
    return Job(
        id=message.id,
        kind=JobKind(jobs_pb2.JobKind.Name(message.kind).removeprefix("JOB_KIND_").lower()),
        state=JobState(jobs_pb2.JobState.Name(message.state).removeprefix("JOB_STATE_").lower()),
        request_id=message.request_id,
        specification=_specification(getattr(message, message.WhichOneof("specification"))),
        priority=message.priority,
        created_at=message.created_at,
        started_at=message.started_at or None,
        finished_at=message.finished_at or None,
        error=JobError(message.error.reason, message.error.detail) if message.HasField("error") else None,
        progress=JobProgress(**{name: getattr(progress, name) if progress.HasField(name) else None for name in names}),
        artifacts=tuple(message.artifacts),
        metrics=dict(message.metrics),
        worker=message.worker or None,
        retry_of=message.retry_of or None,
        attempts=message.attempts,
    )


def _specification(message: jobs_pb2.TrainJob | jobs_pb2.RenderJob) -> dict[str, Any]:
    told: dict[str, Any] = {}
    for field, value in message.ListFields():
        if field.name == "outputs":
            told[field.name] = output_names(value)
        elif field.name == "settings":
            told[field.name] = MessageToDict(value)
        elif field.name == "sampler":
            told[field.name] = {part.name: number for part, number in value.ListFields()}
        else:
            told[field.name] = value
    return told


def _submit(request: jobs_pb2.SubmitJobRequest) -> Operation[Job]:
    return Operation("jobs.SubmitJob", request, lambda answer: job_from_message(answer.job))


def _chosen(request_id: str | None) -> str:
    """With an id of its own a submission that is sent again gives the same job."""
    return uuid.uuid4().hex if request_id is None else request_id
