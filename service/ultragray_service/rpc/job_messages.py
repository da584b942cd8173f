"""Between the messages of jobs and the values of the job store."""

from __future__ import annotations

from typing import Any

from google.protobuf.json_format import MessageToDict, SerializeToJsonError

from ultragray.contract import under
from ultragray.errors import InvalidArgument
from ultragray_proto.v1 import jobs_pb2, scenes_pb2
from ultragray_workers.jobs.kinds import Specification
from ultragray_workers.jobs.specification import from_dict
from ultragray_workers.jobs.store import Job

from .messages import OUTPUT_NUMBERS, output_name, poses_from_messages

STATES: dict[int, str] = {
    jobs_pb2.JOB_STATE_UNSPECIFIED: "",
    jobs_pb2.JOB_STATE_QUEUED: "queued",
    jobs_pb2.JOB_STATE_RUNNING: "running",
    jobs_pb2.JOB_STATE_SUCCEEDED: "succeeded",
    jobs_pb2.JOB_STATE_FAILED: "failed",
    jobs_pb2.JOB_STATE_CANCELLED: "cancelled",
}
KINDS: dict[int, str] = {
    jobs_pb2.JOB_KIND_UNSPECIFIED: "",
    jobs_pb2.JOB_KIND_TRAIN: "train",
    jobs_pb2.JOB_KIND_RENDER: "render",
}
_SAMPLER_NUMBERS = ("count", "translation_mm", "rotation_deg", "seed", "spacing_mm", "tilt_deg", "step_deg")
_OPTIONAL = ("height", "width", "min_confidence")
_PROGRESS = (
    "step",
    "steps",
    "loss",
    "val_psnr_db",
    "gaussians",
    "frames_done",
    "frames",
    "rate_per_s",
    "seconds_left",
    "waits_for",
)


def filter_from_number(number: int, names: dict[int, str], field: str) -> str:
    """The name of an enum's value, empty for none. Raises InvalidArgument."""
    if number not in names:
        raise InvalidArgument(f"{field} must be one of its enum's values, got {number}", field=field)
    return names[number]


def specification_from_message(message: jobs_pb2.SubmitJobRequest) -> tuple[Specification, str]:
    """The checked specification, and the field that holds it.

    Raises InvalidArgument, InvalidPose, UnknownOutput; their field is a path.
    """
    kind = message.WhichOneof("specification")
    if kind is None:
        raise InvalidArgument("train or render is required", field="train")
    with under(kind):
        written = _written_train(message.train) if kind == "train" else _written_render(message.render)
        return from_dict({"kind": kind, **written}), kind


def _written_train(message: jobs_pb2.TrainJob) -> dict[str, Any]:
    written = {"dataset": message.dataset, "scene": message.scene, "settings": _settings(message)}
    return written | {name: value for name in ("preset", "device") if (value := getattr(message, name))}


def _settings(message: jobs_pb2.TrainJob) -> dict[str, Any]:
    """A Struct holds every number as a double: those without a fraction are integers again."""
    try:
        settings = MessageToDict(message.settings)
    except (ValueError, SerializeToJsonError) as error:  # of a number that is not finite
        raise InvalidArgument(f"settings must hold finite numbers: {error}", field="settings") from None
    return {
        name: int(value) if isinstance(value, float) and value.is_integer() else value
        for name, value in settings.items()
    }


def _written_render(message: jobs_pb2.RenderJob) -> dict[str, Any]:
    written: dict[str, Any] = {"scene": message.scene}
    if message.poses:
        written["poses"] = poses_from_messages(message.poses, "poses")
    if message.HasField("sampler"):
        sampler = message.sampler
        numbers = {name: getattr(sampler, name) for name in _SAMPLER_NUMBERS if sampler.HasField(name)}
        written["sampler"] = {"kind": sampler.kind, **numbers}
    written |= {name: getattr(message, name) for name in _OPTIONAL if message.HasField(name)}
    if message.outputs:
        written["outputs"] = [output_name(number) for number in message.outputs]
    return written | {name: value for name in ("format", "dtype") if (value := getattr(message, name))}


def job_message(job: Job) -> jobs_pb2.Job:
    """The message of a job."""
    progress = {name: value for name in _PROGRESS if (value := getattr(job.progress, name)) is not None}
    message = jobs_pb2.Job(
        id=job.id,
        kind=f"JOB_KIND_{job.kind.upper()}",
        state=f"JOB_STATE_{job.state.name}",
        request_id=job.request_id or "",
        priority=job.priority,
        created_at=job.created_at,
        started_at=job.started_at or "",
        finished_at=job.finished_at or "",
        error=scenes_pb2.Error(reason=job.error or "", detail=job.reason) if job.reason else None,
        progress=jobs_pb2.JobProgress(**progress),
        artifacts=job.artifacts,
        metrics=job.metrics,
        worker=job.worker or "",
        retry_of=job.retry_of or "",
        attempts=job.attempts,
    )
    if job.kind == "train":
        _tell_train(message.train, job.specification)
    else:
        _tell_render(message.render, job.specification)
    return message


def _tell_train(message: jobs_pb2.TrainJob, specification: dict[str, Any]) -> None:
    for name in ("dataset", "scene", "preset", "device"):
        setattr(message, name, specification[name])
    message.settings.update(specification["settings"])


def _tell_render(message: jobs_pb2.RenderJob, specification: dict[str, Any]) -> None:
    message.scene, message.format = specification["scene"], specification["format"]
    message.dtype = specification.get("dtype") or ""
    message.pose_count = specification.get("pose_count", 0)
    message.outputs.extend(OUTPUT_NUMBERS[name] for name in specification["outputs"])
    for name in _OPTIONAL:
        if specification.get(name) is not None:
            setattr(message, name, specification[name])
    if specification.get("sampler") is not None:
        message.sampler.CopyFrom(jobs_pb2.PoseSampler(**specification["sampler"]))
