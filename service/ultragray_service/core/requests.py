"""From what a caller asked for to what the pool renders: every check, once, for both front doors."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ultragray.display.settings import AS_RENDERED, Display
from ultragray.errors import InvalidArgument, InvalidImageSize, TooManyPoses, UltragrayError
from ultragray.pose import check_poses
from ultragray.probe import FloatArray, Probe
from ultragray.request import LABELS, check_image_size, check_labelled, check_min_confidence, check_outputs
from ultragray_workers.pool.types import ANY_CONFIDENCE, Encoding, Priority, RenderRequest, Trust

from ..settings import Settings
from .catalog import SceneCatalog

_POSES_CHECKED_INLINE = 16  # more go to a thread, so that the loop keeps answering


@dataclass(frozen=True)
class RenderSpec:
    """What a caller wants rendered, apart from the poses. None: the scene's own."""

    scene: str
    probe: Probe | None
    height: int | None
    width: int | None
    outputs: tuple[str, ...]
    encoding: Encoding
    display: Display = AS_RENDERED
    trust: Trust = ANY_CONFIDENCE


class RequestPlanner:
    """Checks specs and poses against the scenes and the settings."""

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

    async def plan(self, spec: RenderSpec, priority: Priority) -> RenderRequest:
        """A request without poses yet, all else checked and resolved.

        Raises SceneNotFound, SceneFileInvalid, InvalidProbe, InvalidImageSize, UnknownOutput,
        InvalidArgument.
        """
        outputs = check_outputs(spec.outputs)
        header = await self._catalog.header(spec.scene)
        check_labelled(outputs, header.info)
        probe = header.info.probe_or(spec.probe)
        height, width = header.info.image_size_or(spec.height, spec.width)
        check_image_size(height, width, limit=self._settings.max_image_side)
        if spec.encoding in (Encoding.PNG, Encoding.JPEG) and len(outputs) != 1:
            raise InvalidArgument(
                f"encoding {spec.encoding.value} holds exactly one output, got {len(outputs)}",
                field="encoding",
            )
        if spec.encoding is Encoding.JPEG and LABELS in outputs:
            raise InvalidArgument("encoding jpeg would change labels: ask for png, or raw pixels", field="encoding")
        planned = RenderRequest(
            scene=spec.scene,
            poses=np.empty((0, 4, 4)),
            probe=probe,
            height=height,
            width=width,
            outputs=outputs,
            encoding=spec.encoding,
            priority=priority,
            display=spec.display,
            trust=spec.trust,
        )
        check_min_confidence(spec.trust.min_confidence, header.info)
        with field_under("display"):
            pixels = _pixels_of_pose(planned)
        if pixels > self._settings.max_request_pixels:
            raise InvalidImageSize(
                f"height x width x outputs must be at most {self._settings.max_request_pixels} pixels, got {pixels}",
                field="height",
            )
        return planned

    def with_poses(self, planned: RenderRequest, poses: FloatArray, deadline: float) -> RenderRequest:
        """`planned` with checked poses [C, 4, 4]. Raises TooManyPoses for an answer of too many pixels."""
        pixels = len(poses) * _pixels_of_pose(planned)
        if pixels > self._settings.max_request_pixels:
            raise TooManyPoses(
                f"poses x height x width x outputs must be at most {self._settings.max_request_pixels} "
                f"pixels, got {pixels}; send the poses in several requests",
                field="poses",
            )
        return replace(planned, poses=poses, deadline=deadline)

    def deadline(self, timeout_s: float | None) -> float:
        """The time.monotonic() seconds by which a request must begin; None: the default timeout."""
        return time.monotonic() + (self._settings.default_timeout_s if timeout_s is None else timeout_s)


def frame_bytes(planned: RenderRequest) -> int:
    """What the frame of one pose takes at most."""
    return _pixels_of_pose(planned) * planned.encoding.pixel_type.itemsize


def _pixels_of_pose(planned: RenderRequest) -> int:
    """What is rendered or shown for a pose, whichever is more. Raises InvalidImageSize for a picture beyond limits."""
    assert planned.probe is not None
    assert planned.height is not None
    assert planned.width is not None
    picture = planned.display.picture(planned.probe, planned.height, planned.width)
    return max(planned.height * planned.width, picture.height * picture.width) * len(planned.outputs)


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


@contextmanager
def field_under(prefix: str) -> Iterator[None]:
    """Errors from inside name their field as a part of `prefix`."""
    try:
        yield
    except UltragrayError as error:
        if error.field is None:
            raise type(error)(error.detail, field=prefix) from error
        path = f"{prefix}.{error.field}"
        detail = error.detail
        if detail.startswith(error.field):
            detail = f"{prefix}.{detail}"
        raise type(error)(detail, field=path) from error
