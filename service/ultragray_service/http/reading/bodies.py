"""Bodies of HTTP and messages over a WebSocket: the contract's settings, with poses and the times of a request."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import Field, dataclass, field, make_dataclass
from typing import Any, Literal, get_args

import numpy as np

from ultragray.contract import Contract, annotated_fields, described
from ultragray.errors import InvalidArgument, InvalidImageSize, InvalidPose
from ultragray.image_size import MAX_IMAGE_SIDE
from ultragray.learn.localization.settings import LocalizationSettings
from ultragray.probe import Probe
from ultragray.registration.registration import Registration
from ultragray.settings import FrameSettings, RenderSettings, registration_field
from ultragray_service.core.poses import Pose, check_pose_count
from ultragray_service.core.streams.pose_stream import MAX_WINDOW, StreamMode
from ultragray_service.core.streams.stream import MAX_TIMEOUT_MS
from ultragray_service.http.reading.large_json import INLINE_BYTES, Apart
from ultragray_workers.jobs.job import MAX_PRIORITY
from ultragray_workers.jobs.kinds import KINDS, Specification

_POSE_BYTES = 1024  # with room for indentation


def _many_poses(limit: int) -> Apart:
    """The part of a body that may be large."""
    return Apart(
        "poses",
        list,
        Pose,
        InvalidPose,
        lambda count: check_pose_count(count, limit),
        max_bytes=INLINE_BYTES + limit * _POSE_BYTES,
        max_values=math.inf,
    )


@dataclass(frozen=True, kw_only=True)
class AssessBody(Contract):
    """The poses to assess."""

    poses: list[Pose] = described("At least one.", factory=list, error=InvalidPose)
    probe: Probe | None = described("Whose poses they are. Default: the scene's own.", None)
    registration: str | None = registration_field()

    many_poses = staticmethod(_many_poses)


@dataclass(frozen=True, kw_only=True)
class LocalizeBody(LocalizationSettings):
    """A real frame, and about where it was taken."""

    image: str = described(
        "The frame in base64, rows along depth, columns across scan lines, not scan-converted: a PNG file, or, with "
        "image_height and image_width, grey pixels of 8 bits, row by row.",
    )
    image_height: int | None = described("Of grey pixels.", None, low=1, high=MAX_IMAGE_SIDE, error=InvalidImageSize)
    image_width: int | None = described("Of grey pixels.", None, low=1, high=MAX_IMAGE_SIDE, error=InvalidImageSize)
    start: Pose = described("A pose that is about right.", error=InvalidPose)
    registration: str | None = registration_field()
    timeout_ms: float | None = described(
        "A search that has not ended by then is given up (504).", None, above=0, high=MAX_TIMEOUT_MS
    )


LARGE_IMAGE = Apart("image", str)


@dataclass(frozen=True, kw_only=True)
class RenderBody(FrameSettings):
    """What to render. Exactly one of `pose` and `poses`; all else has a default from the scene."""

    pose: Pose | None = described("One pose; rendered before frames of `poses` that wait.", None, error=InvalidPose)
    poses: list[Pose] | None = described("Many poses, answered together, in order.", None, error=InvalidPose)
    registration: str | None = registration_field()
    dtype: Literal["uint8", "float32"] | None = described(
        "Of application/octet-stream; a dtype in the Accept header goes first. Default: uint8.", None
    )
    timeout_ms: float | None = described(
        "A frame that is not ready after this time is given up (504).", None, above=0, high=MAX_TIMEOUT_MS
    )
    max_queue_ms: float | None = described(
        "A request that cannot begin within this time is refused at once (429, QUEUE_FULL); null: see "
        "ULTRAGRAY_MAX_QUEUE_MS, which holds all the same.",
        None,
        above=0,
        high=MAX_TIMEOUT_MS,
    )

    many_poses = staticmethod(_many_poses)

    def poses_by_path(self, limit: int) -> Sequence[tuple[str, Pose]]:
        """The poses, each with its path in the body. Raises InvalidArgument, TooManyPoses."""
        if (self.pose is None) == (self.poses is None):
            raise InvalidArgument("the body must hold exactly one of pose and poses", field="pose")
        if self.pose is not None:
            return [("pose", self.pose)]
        poses = self.poses or []
        check_pose_count(len(poses), limit)
        return [(f"poses[{index}]", pose) for index, pose in enumerate(poses)]


@dataclass(frozen=True, kw_only=True)
class StreamMessage(Contract):
    """One message of the client of a WebSocket."""

    sequence: int = described("Any number; the answer to this message carries it.", 0, low=0, high=2**64 - 1)
    settings: RenderSettings | None = described("Replaces all settings, from this pose on.", None)
    pose: Pose | None = described("null: only the settings change.", None, error=InvalidPose)
    mode: StreamMode | None = described("Of the stream; read from its first message. Default: ordered.", None)
    timeout_ms: float | None = described("Later this pose is not rendered.", None, above=0, high=MAX_TIMEOUT_MS)
    client_time_ms: float | None = described("Any number; the answer carries it.", None)
    window: int | None = described(
        "Of a latest stream, read from its first message: answers that may wait to be acknowledged. Default: the "
        "client acknowledges none.",
        None,
        low=1,
        high=MAX_WINDOW,
    )
    acknowledged: int | None = described(
        "Sequence of the newest answer that the client has taken; it and those before it leave room for others.",
        None,
        low=0,
        high=2**64 - 1,
    )


@dataclass(frozen=True, kw_only=True)
class RegistrationBody(Registration):
    """A registration, and the scene that its poses lead into."""

    scene: str = described("Its name.")


def _body_of(kind: str) -> type[Any]:
    """The class of a specification's JSON, which `kind` stands beside: poses are lists."""
    cls = Specification.member(kind)
    given = [(item, annotation) for item, annotation in annotated_fields(cls) if item.name != "kind"]
    described_fields: list[tuple[str, Any, Any]] = [
        (item.name, _without_arrays(annotation), _again(item)) for item, annotation in given
    ]
    name = f"{kind.title()}Specification"
    return make_dataclass(name, described_fields, namespace={"__doc__": cls.__doc__}, kw_only=True)


def _again(item: Field[Any]) -> Any:
    return field(default=item.default, default_factory=item.default_factory, metadata=item.metadata)


def _without_arrays(annotation: Any) -> Any:
    """An annotation without the arrays that it allows beside lists."""
    kinds = [one for one in get_args(annotation) if getattr(one, "__origin__", None) is not np.ndarray]
    if len(kinds) == len(get_args(annotation)):
        return annotation
    first, *others = kinds
    for other in others:
        first = first | other
    return first


SPECIFICATION = Apart("specification", dict)  # of a job: there may be many poses in it
SPECIFICATIONS = tuple(map(_body_of, KINDS))


@dataclass(frozen=True, kw_only=True)
class JobBody(Contract):
    """A job to be done in the background."""

    kind: str = described("What is to be done.", choices=KINDS)
    specification: dict[str, Any] = field(
        metadata={
            "description": f"{' or '.join(one.__name__ for one in SPECIFICATIONS)}, by kind. Poses may also be "
            "one text: float64, row by row, the low byte first, in base64.",
            "json_schema_extra": {
                "anyOf": [{"$ref": f"#/components/schemas/{one.__name__}"} for one in SPECIFICATIONS]
            },
        }
    )
    request_id: str | None = described(
        "Chosen by the client, 1 to 128 characters: sent again, it gives the same job.", None
    )
    priority: int = described("Higher ones go first.", 0, low=-MAX_PRIORITY, high=MAX_PRIORITY)
    private: bool = described("Whether others may not see it, nor the scene that it makes.", False)
