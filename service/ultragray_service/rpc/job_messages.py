"""Between the messages of jobs and the values of the job store. Knows no kinds: a specification has the fields of the
message that the oneof `specification` holds under its kind.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor
from google.protobuf.json_format import ParseDict

from ultragray.contract import annotated_fields, under
from ultragray.errors import InvalidArgument, UltragrayError
from ultragray_proto.codec import MessageInvalid, from_message, to_message, words
from ultragray_proto.v1 import jobs_pb2, scenes_pb2
from ultragray_workers.jobs.kinds import KINDS, Specification
from ultragray_workers.jobs.store import Job

from .messages import poses_from_messages

_STRUCT = "google.protobuf.Struct"


def filter_from_number(number: int, enum: EnumDescriptor, field: str) -> str:
    """The word of an enum's value, empty for UNSPECIFIED. Raises InvalidArgument."""
    known = {0: "", **words(enum)}
    if number not in known:
        raise InvalidArgument(f"{field} must be one of its enum's values, got {number}", field=field)
    return known[number]


def specification_from_message(message: jobs_pb2.SubmitJobRequest) -> tuple[Specification, str]:
    """The checked specification, and the field that holds it.

    Raises InvalidArgument, InvalidPose, InvalidProbe, UnknownOutput; their field is a path.
    """
    kind = message.WhichOneof("specification")
    if kind is None:
        raise InvalidArgument(f"specification must hold one of {', '.join(KINDS)}", field="specification")
    part = getattr(message, kind)
    with under(kind):
        others = {}
        if "poses" in part.DESCRIPTOR.fields_by_name:  # read all at once: there may be many
            others = {"poses": poses_from_messages(part.poses, "poses") if part.poses else None}
        return _read(part, Specification.member(kind), **others), kind


def _read(message: Any, cls: Any, **others: Any) -> Specification:
    try:
        specification: Specification = from_message(message, cls, **others)
    except MessageInvalid as error:
        if not isinstance(error.original, UltragrayError):
            errors = {item.name: item.metadata.get("error") for item, _ in annotated_fields(cls)}
            cause = errors.get(error.field.partition(".")[0]) or InvalidArgument
            raise cause(str(error), field=error.field) from None
        if not error.field:
            raise error.original from None
        with under(error.field):
            raise error.original from None
    return specification


def job_message(job: Job) -> jobs_pb2.Job:
    """The message of a job."""
    error = scenes_pb2.Error(reason=job.error or "", detail=job.reason) if job.reason else None
    message = jobs_pb2.Job(
        id=job.id,
        kind=f"JOB_KIND_{job.kind.upper()}",
        state=f"JOB_STATE_{job.state.name}",
        request_id=job.request_id or "",
        priority=job.priority,
        created_at=job.created_at,
        started_at=job.started_at or "",
        finished_at=job.finished_at or "",
        error=error,
        progress=to_message(job.progress, jobs_pb2.JobProgress),
        artifacts=job.artifacts,
        metrics=job.metrics,
        worker=job.worker or "",
        retry_of=job.retry_of or "",
        attempts=job.attempts,
    )
    part = getattr(message, job.kind)
    part.SetInParent()
    ParseDict(_fields_of(job.specification, part.DESCRIPTOR), part)
    return message


def _fields_of(document: Mapping[str, Any], descriptor: Descriptor) -> dict[str, Any]:
    """A specification's JSON, or a part of it, in protobuf's JSON."""
    found = {}
    for field in descriptor.fields:
        value = document.get(field.name)
        if value is not None:
            found[field.name] = (
                [_value_of(one, field) for one in value] if field.is_repeated else _value_of(value, field)
            )
    return found


def _value_of(value: Any, field: FieldDescriptor) -> Any:
    if field.enum_type is not None:
        return {word: number for number, word in words(field.enum_type).items()}[value]
    if field.message_type is None or field.message_type.full_name == _STRUCT:
        return value
    member = field.message_type.fields_by_name.get(value.get("kind", ""))
    if member is not None:  # a oneof by kinds
        return {member.name: _fields_of(value, member.message_type)}
    return _fields_of(value, field.message_type)
