"""Messages of gRPC as the service reads and writes them, by the codec."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from ultragray.contract import blamed, under
from ultragray.errors import InvalidArgument, InvalidPose, UltragrayError
from ultragray.geometry.pose import check_poses, pose_from_position_quaternion
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.rendering.settings import RenderSettings, Resolved, settings_used
from ultragray.rendering.volumes import SliceView
from ultragray_proto.codec import MessageInvalid, from_message, to_message, words
from ultragray_proto.v1 import geometry_pb2, jobs_pb2, rendering_pb2, scenes_pb2
from ultragray_service.core.poses import SliceFacts, exact_pose
from ultragray_workers.jobs.kinds import KINDS, Specification
from ultragray_workers.jobs.record import Job
from ultragray_workers.pool.messages import RenderResult

_LENGTH_DELIMITED = 2  # the wire type of bytes


@dataclass(frozen=True)
class OfProbe:
    """The part of a request that says whose poses it has, and in which frame."""

    probe: Probe | None = None
    registration: str | None = None


def read(message: Any, cls: Any, **others: Any) -> Any:
    """The contract's dataclass of a message. Raises its own errors, and InvalidArgument, with the path of the field."""
    try:
        return from_message(message, cls, **others)
    except MessageInvalid as error:
        if isinstance(error.original, UltragrayError):
            if not error.field:
                raise error.original from None
            with under(error.field):
                raise error.original from None
        _, refused, _ = blamed(cls, error.field.split("."))
        raise refused(str(error), field=error.field) from None


def read_settings(message: Any) -> tuple[str, RenderSettings]:
    if not message.HasField("settings"):
        raise InvalidArgument("settings is required", field="settings")
    with under("settings"):
        return message.settings.scene, read(message.settings, RenderSettings)


def read_word(message: Any, field: str) -> str:
    """The word of an enum of a message, empty for UNSPECIFIED. Raises InvalidArgument."""
    enum, number = message.DESCRIPTOR.fields_by_name[field].enum_type, getattr(message, field)
    known = {0: "", **words(enum)}
    if number not in known:
        raise InvalidArgument(f"{field} must be one of the enum {enum.name}, got {number}", field=field)
    return known[number]


def read_pose(message: geometry_pb2.Pose, field: str) -> FloatArray:  # [4, 4] mm
    form = message.WhichOneof("form")
    if form == "matrix":
        values = message.matrix.values
        if len(values) != 16:
            raise InvalidPose(
                f"{field}.matrix.values must hold 16 numbers, row by row, got {len(values)}",
                field=f"{field}.matrix.values",
            )
        return exact_pose(np.array(values).reshape(4, 4), f"{field}.matrix")
    if form != "placement":
        raise InvalidPose(f"{field} must hold matrix or placement", field=field)
    placement = message.placement
    for part in ("position_mm", "quaternion"):
        if not placement.HasField(part):
            raise InvalidPose(f"{field}.placement.{part} is required", field=f"{field}.placement.{part}")
    p, q = placement.position_mm, placement.quaternion
    return pose_from_position_quaternion((p.x, p.y, p.z), (q.w, q.x, q.y, q.z), field=f"{field}.placement")


def read_poses(messages: Sequence[geometry_pb2.Pose], field: str) -> FloatArray:  # [C, 4, 4] mm
    if all(pose.WhichOneof("form") == "matrix" and len(pose.matrix.values) == 16 for pose in messages):
        matrices = np.empty((len(messages), 16))
        for index, pose in enumerate(messages):
            matrices[index] = pose.matrix.values
        with suppress(InvalidPose):  # raised below, with the name of the pose
            return check_poses(matrices.reshape(-1, 4, 4))
    return np.stack([read_pose(pose, f"{field}[{index}]") for index, pose in enumerate(messages)])


def serialized_frame(result: RenderResult, sequence: int, **others: Any) -> bytes:
    """A Frame as it is sent. Its pixels are copied once, into these bytes: a message would copy them three times.

    The fields of a message may be written in any order and in several pieces.
    """
    if (place := result.place) is not None:
        others["shared_data"] = rendering_pb2.SharedData(slot=place.slot, bytes=place.size)
    facts = rendering_pb2.Frame(
        sequence=sequence,
        pose=geometry_pb2.Matrix(values=result.poses[0].ravel().tolist()),
        timings=to_message(result, rendering_pb2.Timings),
        extrapolation=to_message(result.extrapolations[0], rendering_pb2.Extrapolation),
        **others,
    )
    same = _same_bytes(result.settings, result.scene, result.scene_sha256, result.renderer)
    return b"".join((same, facts.SerializeToString(), _data_key(len(result.data)), result.data))


@lru_cache(maxsize=256)
def _same_bytes(settings: Resolved, scene: str, scene_sha256: str, renderer: str) -> bytes:
    """The part of a frame that is the same for all frames of a stream: first, so that clients read it once."""
    used, origin = settings_used(settings), {"scene": scene, "scene_sha256": scene_sha256, "renderer": renderer}
    return bytes(to_message(used, rendering_pb2.Frame, **origin).SerializeToString())


@lru_cache(maxsize=256)
def _data_key(size: int) -> bytes:
    """What stands before the bytes of Frame.data, so many of them (protobuf.dev/programming-guides/encoding)."""
    field = rendering_pb2.Frame.DESCRIPTOR.fields_by_name["data"].number
    return _varint(field << 3 | _LENGTH_DELIMITED) + _varint(size)


def _varint(number: int) -> bytes:
    """A whole number, seven bits a byte, the lowest first; all bytes but the last have the highest bit set."""
    groups = [number >> shift & 0x7F for shift in range(0, max(1, number.bit_length()), 7)]
    return bytes([*(group | 0x80 for group in groups[:-1]), groups[-1]])


def slice_message(result: RenderResult[SliceView]) -> rendering_pb2.Slice:
    return to_message(SliceFacts.of(result), rendering_pb2.Slice, data=result.data)


def read_specification(message: jobs_pb2.SubmitJobRequest) -> tuple[Specification, str]:
    """The checked specification, and the field that holds it. Raises InvalidArgument and its kinds; field: a path."""
    kind = message.WhichOneof("specification")
    if kind is None:
        raise InvalidArgument(f"specification must hold one of {', '.join(KINDS)}", field="specification")
    body = getattr(message, kind)
    with under(kind):
        values = {"poses": read_poses(body.poses, "poses") if body.poses else None} if hasattr(body, "poses") else {}
        specification: Specification = read(body, Specification.member(kind), **values)
    return specification, kind


def job_message(job: Job) -> jobs_pb2.Job:
    error = None if job.reason is None else scenes_pb2.Error(reason=job.error or "", detail=job.reason)
    view = replace(job, specification={"kind": job.kind, **job.specification}, error=None)
    return to_message(view, jobs_pb2.Job, error=error)
