"""Jobs as messages."""

from __future__ import annotations

from dataclasses import replace

from ultragray.contract import under
from ultragray.errors import InvalidArgument
from ultragray_proto.codec import to_message
from ultragray_proto.v1 import jobs_pb2, scenes_pb2
from ultragray_workers.jobs.job import Job
from ultragray_workers.jobs.kinds import KINDS, Specification

from .messages import read, read_poses


def read_specification(message: jobs_pb2.SubmitJobRequest) -> tuple[Specification, str]:
    """The checked specification, and the field that holds it.

    Raises InvalidArgument, InvalidPose, UnknownOutput; their field is a path.
    """
    kind = message.WhichOneof("specification")
    if kind is None:
        raise InvalidArgument(f"specification must hold one of {', '.join(KINDS)}", field="specification")
    asked = getattr(message, kind)
    with under(kind):
        given = {"poses": read_poses(asked.poses, "poses") if asked.poses else None} if hasattr(asked, "poses") else {}
        specification: Specification = read(asked, Specification.member(kind), **given)
    return specification, kind


def job_message(job: Job) -> jobs_pb2.Job:
    """The message of a job."""
    error = None if job.reason is None else scenes_pb2.Error(reason=job.error or "", detail=job.reason)
    shown = replace(job, specification={"kind": job.kind, **job.specification}, error=None)
    return to_message(shown, jobs_pb2.Job, error=error)
