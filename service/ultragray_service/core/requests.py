"""From what a caller asked for to what the pool renders: every check, once, for both front doors."""

from __future__ import annotations

import time
from functools import lru_cache

from ultragray.contract import under
from ultragray.errors import InvalidImageSize, TooManyPoses
from ultragray.settings import Encoding, FrameSettings, Resolved

from ..settings import Settings
from .catalog import SceneCatalog


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
        settings = _the_same(asked.resolved(header.info, encoding, max_image_side=self._settings.max_image_side))
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


@lru_cache(maxsize=256)
def _the_same(settings: Resolved) -> Resolved:
    """One object for equal settings, so that their picture is worked out once."""
    return settings
