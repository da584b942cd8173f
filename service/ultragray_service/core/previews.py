"""The preview of a stream: real frames that come late correct what the scene shows at the present pose.

    poses ─────────────► the scene's frame of the present ───────┐
    real frames, late ─► the scene's frame at their pose ─► Previewer ─► what the client is shown

A real frame that is not like the scene's at its pose is searched for about it, beside all this: the offset of the
place where it is found, a motion of the scene's frame, is believed where the scene is more like the real frame there.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray.geometry.motion import Stamps
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import blended, rotation_angles_deg
from ultragray.learn.localization.pixels import EncodedFrame
from ultragray.learn.localization.settings import Localization, LocalizationSettings
from ultragray.rendering.display import AS_RENDERED
from ultragray.rendering.pixels import ByteArray, in_type
from ultragray.rendering.preview import AGREES, Grey, Preview, Previewer, agreement
from ultragray.rendering.settings import Encoding, Resolved
from ultragray_service.access.principals import caller
from ultragray_service.core.rendering import Plan, Rendering
from ultragray_workers.pool.messages import (
    Priority,
    RenderRequest,
    RenderResult,
    SceneChangedError,
    SearchResult,
    Sought,
)

FRAMES_OF_A_SEARCH = 100  # that it counts as: it takes as long, at 512x512
_POSES = 1024  # that are kept for the real frames to come
_SEARCH_EVERY_S = 2.0
_FALLEN = 0.8  # of the agreement after the last search: less calls for another one
_MOST_MM, _MOST_DEG = 10.0, 10.0  # of an offset
_RAW = (Encoding.UINT8, Encoding.FLOAT32, Encoding.FLOAT16)


@dataclass(frozen=True, eq=False)
class RealFrame:
    """A frame of the real probe, and when it was taken, by the clock that poses have their times of."""

    image: EncodedFrame
    measured_s: float


@dataclass(frozen=True, eq=False)
class _Placed:
    """A real frame at the pose that the stream had at its time."""

    pixels: ByteArray  # [h, w] as it came
    grey: Grey  # [H, W] of the stream's frames
    pose: FloatArray  # [4, 4] mm
    measured_s: float
    plan: Plan


class StreamPreview:
    """The preview of one stream. It is on once a real frame has been compared with the scene."""

    def __init__(self, rendering: Rendering) -> None:
        self._rendering = rendering
        self._stamps = Stamps()
        self._path: deque[tuple[float, FloatArray]] = deque(maxlen=_POSES)
        self._offset = np.eye(4)  # from where poses are to where the scene is like the real frames
        self._view: tuple[object, ...] = ()  # of the frames that the previewer has
        self._previewer: Previewer | None = None
        self._turn = asyncio.Lock()  # of the previewer
        self._waiting: _Placed | None = None
        self._newest: _Placed | None = None  # of those that were compared
        self._agreement, self._agreed = 0.0, np.inf  # of the newest, and after the last search
        self._searched_at_s = -np.inf
        self._comparing: asyncio.Task[None] | None = None
        self._searching: asyncio.Task[None] | None = None

    @property
    def is_on(self) -> bool:
        return self._newest is not None

    def note(self, measured_s: float, pose: FloatArray) -> None:
        """Takes a pose [4, 4] mm, in the scene. A late one, not newer than the newest, is left out."""
        if self._stamps.begin_anew(measured_s):
            self._path.clear()
            self._newest = self._waiting = None  # of the clock as it was
        if not self._path or measured_s > self._path[-1][0]:
            self._path.append((measured_s, pose))

    def corrected(self, pose: FloatArray) -> FloatArray:  # [4, 4] both
        """Where the scene is to be rendered for a pose."""
        return self._offset @ pose if self.is_on else pose

    async def take(self, frame: RealFrame, plan: Plan | None) -> None:
        """Takes a real frame; while one is being compared, the newest waits.

        Raises InvalidArgument for one that cannot be compared, and InvalidImageSize.
        """
        if plan is None:
            raise InvalidArgument("a pose must come before a real frame", field="real")
        check_settings(plan.settings)
        pose = self._pose_at(frame.measured_s)
        pixels = await asyncio.to_thread(frame.image.pixels)
        size = (plan.settings.width, plan.settings.height)
        grey = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(255.0)
        self._waiting = _Placed(pixels, grey, pose, frame.measured_s, plan)
        if self._comparing is None or self._comparing.done():
            self._comparing = asyncio.create_task(self._compare())

    async def shown(self, result: RenderResult, pose: FloatArray, at_s: float) -> tuple[RenderResult, Preview | None]:
        """A frame of the scene as the client is shown it; `pose`: before the offset; `at_s`: its time.

        None: no real frame is of such frames.
        """
        began = time.perf_counter()
        async with self._turn:
            newest, agreed = self._newest, self._agreement
            if newest is None or self._previewer is None or result.settings.view != self._view:
                return result, None
            preview_frame = await asyncio.to_thread(self._previewer.show, _grey(result), pose)
        data = in_type(preview_frame.frame, result.settings.encoding.pixel_type).tobytes()
        confidence = result.extrapolations[0].confidence
        offset = result.poses[0] @ np.linalg.inv(pose)  # that it was rendered with: perhaps not the newest
        offset_mm, offset_deg = self._lengths(offset, newest)
        preview = Preview(
            real_age_ms=round(1e3 * (at_s - newest.measured_s), 3),
            moved_mm=round(preview_frame.moved_mm, 3),
            is_real=preview_frame.is_real,
            expected_error=None if preview_frame.expected_error is None else round(preview_frame.expected_error, 4),
            agreement=round(agreed, 3),
            trust=None if confidence is None else round(confidence * max(agreed, 0.0), 3),
            offset_mm=round(offset_mm, 3),
            offset_deg=round(offset_deg, 3),
            disagrees=agreed < AGREES,
        )
        encode_ms = result.encode_ms + 1e3 * (time.perf_counter() - began)
        return replace(result, data=data, encode_ms=encode_ms), preview

    async def close(self) -> None:
        """Ends what is under way."""
        tasks = [task for task in (self._comparing, self._searching) if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _pose_at(self, measured_s: float) -> FloatArray:  # [4, 4]
        """The pose at a time, straight between the two about it. Raises InvalidArgument where there are none."""
        path = list(self._path)
        after = next((k for k, (at_s, _) in enumerate(path) if at_s >= measured_s), None)
        if after is None or (after == 0 and path[0][0] != measured_s):
            known = f"from {path[0][0]:.3f} to {path[-1][0]:.3f} s" if path else "no pose has a time"
            raise InvalidArgument(
                f"a real frame must be of a time between those of poses, {known}, got {measured_s:.3f} s", field="real"
            )
        (before_s, before), (after_s, later) = path[max(after - 1, 0)], path[after]
        share = (measured_s - before_s) / (after_s - before_s) if after_s > before_s else 1.0
        pose = before + share * (later - before)
        pose[:3, :3] = blended(before[None, :3, :3], later[None, :3, :3], np.array([share]))[0]
        return pose

    async def _compare(self) -> None:
        while (frame := self._waiting) is not None:
            self._waiting = None
            try:
                await self._take_in(frame, self._offset)
            except UltragrayError:
                continue  # what keeps the scene's frame away is told with the client's own
            is_due = time.monotonic() - self._searched_at_s >= _SEARCH_EVERY_S
            if (
                is_due
                and self._agreement <= _FALLEN * self._agreed
                and (self._searching is None or self._searching.done())
            ):
                self._searching = asyncio.create_task(self._search(frame, self._agreement))

    async def _take_in(self, frame: _Placed, offset: FloatArray, more_than: float = -2.0) -> None:
        """Compares with the scene at an offset, which is believed where they agree by more than that."""
        known = self._offset
        rendered = await self._rendered(frame, offset)
        score = await asyncio.to_thread(agreement, frame.grey, rendered)
        if score <= more_than or self._offset is not known:
            return
        view = frame.plan.settings.view
        async with self._turn:
            if self._previewer is None or view != self._view or offset is not known:
                self._previewer, self._view = Previewer(frame.plan.settings.probe), view
            await asyncio.to_thread(self._previewer.observe, frame.grey, rendered, frame.pose)
            self._offset, self._agreement, self._newest = offset, score, frame

    async def _search(self, frame: _Placed, agreed: float) -> None:
        self._searched_at_s = time.monotonic()
        try:
            match = (await self._located(frame)).found
            offset = match.pose @ np.linalg.inv(frame.pose)
            moved_mm, turned_deg = self._lengths(offset, frame)
            if match.is_found and moved_mm <= _MOST_MM and turned_deg <= _MOST_DEG:
                await self._take_in(frame, offset, more_than=agreed)
        except (UltragrayError, SceneChangedError):
            return
        finally:
            self._agreed = self._agreement

    async def _located(self, frame: _Placed) -> SearchResult[Localization]:
        rendering, plan = self._rendering, frame.plan
        deadline = rendering.planner.deadline(None)
        await rendering.limits.take_frames(FRAMES_OF_A_SEARCH, deadline)
        height, width = frame.pixels.shape
        sought = Sought(frame.pixels.tobytes(), LocalizationSettings(probe=plan.settings.probe), (height, width))
        start = (self._offset @ frame.pose)[None]
        return await rendering.pool.search(
            RenderRequest(plan.scene, sought, start, Priority.BATCH, deadline, plan.version, caller())
        )

    async def _rendered(self, frame: _Placed, offset: FloatArray) -> Grey:
        deadline = self._rendering.planner.deadline(None)
        await self._rendering.limits.frame_turn(deadline)
        return _grey(await self._rendering.render(frame.plan, (offset @ frame.pose)[None], deadline=deadline))

    @staticmethod
    def _lengths(offset: FloatArray, frame: _Placed) -> tuple[float, float]:  # mm, degrees
        middle = frame.pose @ [*frame.plan.settings.probe.points_mm(np.array(0.5), np.array(0.5)), 1.0]
        turned_deg = rotation_angles_deg(np.eye(3)[None], offset[None, :3, :3]).item()
        return float(np.linalg.norm(offset @ middle - middle)), turned_deg


def check_settings(settings: Resolved) -> None:
    """Raises InvalidArgument for settings whose frames no real frame can be compared with."""
    if settings.outputs != ("bmode",) or settings.display != AS_RENDERED or settings.encoding not in _RAW:
        raise InvalidArgument(
            "real frames are compared with frames as they are rendered: settings must have the output bmode alone, "
            f"no display, and an encoding of {', '.join(one.value for one in _RAW)}",
            field="real",
        )


def _grey(result: RenderResult) -> Grey:  # [H, W]
    pixels = np.frombuffer(result.data, result.settings.encoding.pixel_type)
    scale = np.float32(255.0) if pixels.dtype == np.uint8 else np.float32(1.0)
    return pixels.astype(np.float32).reshape(result.height, result.width) / scale
