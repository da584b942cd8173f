"""Poses and frames as the front doors take and tell them: what renders a frame again, and what it cost."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from typing_extensions import Self

from ultragray.contract import Contract, described, made_of
from ultragray.errors import InvalidArgument, InvalidPose, TooManyPoses
from ultragray.geometry.pose import check_poses, pose_from_position_quaternion, quaternion_from_pose
from ultragray.geometry.probe import FloatArray
from ultragray.rendering.settings import Encoding, SettingsUsed
from ultragray.rendering.volumes import SliceView
from ultragray.scene.confidence import Extrapolation
from ultragray_workers.pool.messages import RenderResult

_CHECKED_INLINE = 16  # more go to a thread, so that the loop keeps answering

MatrixRow = Annotated[list[float], Field(min_length=4, max_length=4)]
MatrixRows = Annotated[list[MatrixRow], Field(min_length=4, max_length=4)]


@dataclass(frozen=True)
class Position:
    """A point in the scene frame, mm."""

    x: float
    y: float
    z: float

    __pydantic_config__ = Contract.__pydantic_config__

    @classmethod
    def of(cls, point: Any) -> Position:  # [3] mm
        x, y, z = (float(value) for value in point)
        return cls(x, y, z)


@dataclass(frozen=True)
class Quaternion:
    """A rotation from the probe to the scene, unit norm within 1e-3."""

    w: float
    x: float
    y: float
    z: float

    __pydantic_config__ = Contract.__pydantic_config__


@dataclass(frozen=True)
class Pose:
    """A rigid probe-to-scene transform: `matrix` (4x4, mm), or `position_mm` and `quaternion`."""

    matrix: MatrixRows | None = None
    position_mm: Position | None = None
    quaternion: Quaternion | None = None

    __pydantic_config__ = Contract.__pydantic_config__

    def exact(self, path: str) -> FloatArray:  # [4, 4] mm
        """The exact pose. Raises InvalidPose, naming the part of `path` to blame."""
        if self.matrix is not None:
            if self.position_mm is not None or self.quaternion is not None:
                raise InvalidPose(
                    f"{path} must hold either matrix, or position_mm and quaternion, not both", field=path
                )
            return exact_pose(self.matrix, f"{path}.matrix")
        if self.position_mm is None and self.quaternion is None:
            raise InvalidPose(f"{path} must hold either matrix, or position_mm and quaternion", field=path)
        if self.position_mm is None:
            raise InvalidPose(f"{path}.position_mm is required beside quaternion", field=f"{path}.position_mm")
        if self.quaternion is None:
            raise InvalidPose(f"{path}.quaternion is required beside position_mm", field=f"{path}.quaternion")
        p, q = self.position_mm, self.quaternion
        return pose_from_position_quaternion((p.x, p.y, p.z), (q.w, q.x, q.y, q.z), field=path)


@dataclass(frozen=True)
class PoseInBothForms:
    """A pose as a matrix (4x4, mm), and as position and rotation."""

    matrix: list[list[float]]
    position_mm: Position
    quaternion: Quaternion

    @classmethod
    def of(cls, pose: FloatArray) -> PoseInBothForms:  # [4, 4] mm
        return cls(pose.tolist(), Position.of(pose[:3, 3]), Quaternion(*quaternion_from_pose(pose)))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> FloatArray:  # [4, 4] mm
        return np.array(self.matrix, dtype)


def exact_pose(matrix: Any, path: str) -> FloatArray:  # [4, 4] mm
    pose: FloatArray = check_poses(matrix, field=path)[0]
    return pose


async def exact_poses(count: int, pose: Callable[[int], FloatArray]) -> FloatArray:  # [C, 4, 4] mm
    """The poses 0 to count − 1, each from `pose`, which checks it."""

    def stack() -> FloatArray:
        return np.stack([pose(index) for index in range(count)])

    return stack() if count <= _CHECKED_INLINE else await asyncio.to_thread(stack)


def check_pose_count(count: int, limit: int) -> None:
    if count > limit:
        raise TooManyPoses(f"poses must be at most {limit}, got {count}", field="poses")
    if count == 0:
        raise InvalidArgument("poses must hold at least one pose, got none", field="poses")


def _timings(result: RenderResult[Any]) -> dict[str, float]:
    return {name: round(getattr(result, name), 3) for name in ("queue_ms", "render_ms", "encode_ms")}


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameFacts:
    """The facts of one frame beside its settings: its origin, its pose, and what it cost."""

    scene: str = described("Name.")
    scene_sha256: str = described("Of the scene file.")
    renderer: str = described("Name, version and backend of the renderer.")
    pose: MatrixRows = described("Matrix as used.")
    extrapolation: Extrapolation = described("How far the frame lies from the training views.")
    queue_ms: float = described("Waiting time.")
    render_ms: float = described("Of the batch that it was rendered in.")
    encode_ms: float = described("Encoding time.")

    @classmethod
    def of(cls, result: RenderResult, **others: Any) -> Self:
        return cls(
            scene=result.scene,
            scene_sha256=result.scene_sha256,
            renderer=result.renderer,
            pose=result.poses[0].tolist(),
            extrapolation=result.extrapolations[0],
            **_timings(result),
            **others,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameHeader(SettingsUsed, FrameFacts):
    """All that is needed to render a frame again, and what it cost."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SliceFacts:
    """A slice but for its pixels."""

    scene: str
    scene_sha256: str
    field: str
    height: int
    width: int
    encoding: Encoding
    pixel_to_scene: FloatArray  # [4, 4] mm
    queue_ms: float
    render_ms: float
    encode_ms: float

    @classmethod
    def of(cls, result: RenderResult[SliceView]) -> SliceFacts:
        view = result.settings
        return made_of(cls, view, result, pixel_to_scene=view.grid(result.poses[0]).affine, **_timings(result))

    @property
    def timings(self) -> SliceFacts:
        """Itself: gRPC has the three times in a message of their own."""
        return self
