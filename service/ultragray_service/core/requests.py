"""From what a caller asked for to what the pool renders: every check, once, for both front doors."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ultragray.contract import under
from ultragray.errors import InvalidArgument, InvalidImageSize, TooManyPoses
from ultragray.pose import check_poses
from ultragray.probe import FloatArray
from ultragray.settings import Encoding, FrameSettings, Resolved

from ..settings import Settings
from .catalog import SceneCatalog

_POSES_CHECKED_INLINE = 16  # more go to a thread, so that the loop keeps answering


class RequestPlanner:
    """Checks requests against the scenes and the limits of the service."""

    def __init__(self, settings: Settings, catalog: SceneCatalog) -> None:
        self._settings = settings
        self._catalog = catalog

    @property
    def max_poses(self) -> int:
        """Poses that one call may carry."""
        return self._settings.max_poses_per_request

    @property
    def max_poses_at_once(self) -> int:
        """Poses that one answer may carry: they all wait in the queue at the same time."""
        return min(self._settings.max_poses_per_request, self._settings.queue_limit_frames)

    async def resolve(self, scene: str, asked: FrameSettings, encoding: Encoding) -> Resolved:
        """The settings for a scene, with nothing left open.

        Raises SceneNotFound, SceneFileInvalid, InvalidProbe, InvalidImageSize, UnknownOutput, InvalidArgument.
        """
        header = await self._catalog.header(scene)
        settings = asked.resolved(header.info, encoding, max_image_side=self._settings.max_image_side)
        with under("display"):
            pixels = settings.pixels
        if pixels > self._settings.max_request_pixels:
            raise InvalidImageSize(
                f"height x width x outputs must be at most {self._settings.max_request_pixels} pixels, got {pixels}",
                field="height",
            )
        return settings

    def check_pixels(self, settings: Resolved, poses: int) -> None:
        """Raises TooManyPoses for an answer of more pixels than one may have."""
        pixels = poses * settings.pixels
        if pixels > self._settings.max_request_pixels:
            raise TooManyPoses(
                f"poses x height x width x outputs must be at most {self._settings.max_request_pixels} "
                f"pixels, got {pixels}; send the poses in several requests",
                field="poses",
            )

    def deadline(self, timeout_s: float | None) -> float:
        """The time.monotonic() seconds by which a request must begin; None: the default timeout."""
        return time.monotonic() + (self._settings.default_timeout_s if timeout_s is None else timeout_s)


def check_pose_count(count: int, limit: int) -> None:
    """Raises TooManyPoses above `limit`, InvalidArgument for none."""
    if count > limit:
        raise TooManyPoses(f"poses must be at most {limit}, got {count}", field="poses")
    if count == 0:
        raise InvalidArgument("poses must hold at least one pose, got none", field="poses")


async def gather_poses(count: int, pose: Callable[[int], FloatArray]) -> FloatArray:  # [C, 4, 4]
    """The checked poses 0 to count − 1, each from `pose`."""

    def stack() -> FloatArray:
        return np.stack([pose(index) for index in range(count)])

    return stack() if count <= _POSES_CHECKED_INLINE else await asyncio.to_thread(stack)


def one_pose(matrix: Any, *, field: str) -> FloatArray:  # [4, 4] mm
    """The exact pose of a 4x4 matrix. Raises InvalidPose."""
    pose: FloatArray = check_poses(matrix, field=field)[0]
    return pose
