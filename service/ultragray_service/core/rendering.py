"""From what a caller asks for to what the pool renders: every check, once, for all front doors.

A door reads a request into settings and poses; `RequestPlanner` resolves the settings for the scene as it is now, in a
`Plan`; `Rendering` gives plan and poses to the pool, again where the scene changed in between.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import lru_cache
from typing import Generic, cast

import numpy as np

from ultragray.contract import join, under
from ultragray.errors import FrameTooCostly, InvalidImageSize, RenderFailed, TooManyPoses
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.registration import Registration
from ultragray.rendering.pixels import encoded_image
from ultragray.rendering.settings import Encoding, FrameSettings, Resolved
from ultragray.rendering.volumes import (
    CROWDED_PIECE_PIXELS,
    MOST_PIECES,
    PIECE_PIXELS,
    SliceSettings,
    SliceView,
    as_grey,
    check_field,
    numbers_of,
)
from ultragray.scene.info import SceneHeader, SceneInfo
from ultragray_service.access.audit import account
from ultragray_service.access.limits import Limits
from ultragray_service.access.owners import Owners
from ultragray_service.access.principals import caller
from ultragray_service.core.life import Life
from ultragray_service.core.scenes import SceneCatalog, scene_to_blame
from ultragray_service.settings import Settings
from ultragray_service.telemetry.metrics import Metrics
from ultragray_workers.errors import NotReady, SceneNotFound
from ultragray_workers.jobs.owners import Kind
from ultragray_workers.pool.messages import Destination, Priority, RenderRequest, RenderResult, S, SceneChangedError
from ultragray_workers.pool.pool import MAX_SCENE_CHANGES, RenderPool
from ultragray_workers.scene_names import base_name
from ultragray_workers.storage.local import FileVersion

CROWDED_QUEUE_MS = 3.0  # a piece of a slice that nobody else is in the way of begins sooner


class Plan(Generic[S]):
    """What a client wants of a scene: its settings, with nothing left open as the scene is now.

    A frame is rendered for the version of the scene's file that they are for. Where the file has another by then, they
    are resolved anew: what they left open is as the new scene has it. A scene that is asked for with a pin must have
    that content.
    """

    settings: S
    version: FileVersion
    header: SceneHeader
    registration: Registration | None  # that leads the poses into the scene

    def __init__(
        self,
        catalog: SceneCatalog,
        scene: str,
        resolve: Callable[[SceneInfo], S],
        path: str,
        registration: Registration | None = None,
    ) -> None:
        """`path`: the place of the settings in the client's message, for errors. To be renewed before it is used."""
        self.scene = base_name(scene)
        self._reference = scene
        self._catalog, self._resolve, self._path, self.registration = catalog, resolve, path, registration

    def placed(self, poses: FloatArray) -> FloatArray:  # [..., 4, 4] mm, exact, both
        return poses if self.registration is None else self.registration.probe_to_scene(poses)

    async def renew(self) -> None:
        """Resolves the settings for the scene as it is now. Raises what RequestPlanner.plan raises."""
        with under(self._path) if self._path else nullcontext():
            version, header = await self._catalog.versioned_header(self._reference)
            self.settings, self.version, self.header = self._resolve(header.info), version, header


def as_resolved(settings: Resolved) -> Resolved:
    return settings


class RequestPlanner:
    def __init__(
        self, settings: Settings, catalog: SceneCatalog, registration: Callable[[str, str], Awaitable[Registration]]
    ) -> None:
        self._settings, self._catalog, self._registration = settings, catalog, registration

    @property
    def max_poses(self) -> int:
        return self._settings.max_poses_per_request

    @property
    def max_poses_at_once(self) -> int:
        """Poses that one answer may carry: they all wait in the queue at the same time."""
        return min(self._settings.max_poses_per_request, self._settings.queue_limit_frames)

    async def plan(
        self,
        scene: str,
        request: FrameSettings,
        encoding: Encoding,
        *,
        path: str = "",
        registration: str | None = None,
        complete: Callable[[Resolved], Resolved] = as_resolved,
    ) -> Plan:
        """The settings for a scene, with nothing left open; `complete` checks or adds what only the door knows.

        Raises SceneNotFound, SceneFileInvalid, InvalidProbe, InvalidImageSize, UnknownOutput, InvalidArgument,
        RegistrationNotFound, and what `complete` raises; `path` is the place of the settings in the client's message.
        """
        named_registration = None
        if registration is not None:
            with under(path) if path else nullcontext():
                await self._catalog.header(scene)
                named_registration = await self._registration(registration, scene)

        def resolved(info: SceneInfo) -> Resolved:
            return complete(self._resolved(info, request, encoding, registration))

        plan = Plan(self._catalog, scene, resolved, path, named_registration)
        await plan.renew()
        return plan

    async def plan_slice(
        self, scene: str, request: SliceSettings, encoding: Encoding, *, path: str = ""
    ) -> Plan[SliceView]:
        """The settings of a slice; `path`: their place in the message. Raises SceneNotFound, InvalidArgument."""
        view = request.view(encoding)
        side, pixels = max(view.height, view.width), view.height * view.width
        if side > self._settings.max_image_side or pixels > self._settings.max_request_pixels:
            raise InvalidImageSize(
                f"a slice may have at most {self._settings.max_image_side} pixels on a side and "
                f"{self._settings.max_request_pixels} in all, size_mm and spacing_mm give {view.height}x{view.width}",
                field=join(path, "spacing_mm"),
            )

        def resolve(info: SceneInfo) -> SliceView:
            with under(path) if path else nullcontext():
                check_field(request.field, has_labels=bool(info.label_names))
            return view

        plan = Plan(self._catalog, scene, resolve, "")
        await plan.renew()
        return plan

    def _resolved(
        self, info: SceneInfo, request: FrameSettings, encoding: Encoding, registration: str | None
    ) -> Resolved:
        resolved = request.resolved(info, encoding, max_image_side=self._settings.max_image_side)
        settings = _the_same(resolved if registration is None else replace(resolved, registration=registration))
        with under("display"):
            pixels = settings.pixels
        if pixels > self._settings.max_request_pixels:
            raise InvalidImageSize(
                f"height x width x outputs must be at most {self._settings.max_request_pixels} pixels, got {pixels}",
                field="height",
            )
        return settings

    def check_pixels(self, settings: Resolved, poses: int) -> Resolved:
        """The settings. Raises TooManyPoses for an answer of more pixels than one may have."""
        pixels = poses * settings.pixels
        if pixels > self._settings.max_request_pixels:
            raise TooManyPoses(
                f"poses x height x width x outputs must be at most {self._settings.max_request_pixels} "
                f"pixels, got {pixels}; send the poses in several requests",
                field="poses",
            )
        return settings

    def deadline(self, timeout_s: float | None) -> float:
        """The time.monotonic() seconds after a time; None: after the default timeout."""
        return time.monotonic() + (self._settings.default_timeout_s if timeout_s is None else timeout_s)


class PendingFrames(Generic[S]):
    """Frames that wait for their turn, or are rendered. A context manager, which ends that.

    They are asked for again where the scene's file has changed by their turn.
    """

    def __init__(self, pool: RenderPool, plan: Plan[S], request: RenderRequest[S], settings: S | None) -> None:
        """`settings`: in place of those of the plan."""
        self._pool, self._plan, self._settings = pool, plan, settings
        self._turn = pool.ask(request)

    def give_to(self, poses: FloatArray, deadline: float | None) -> bool:  # [C, 4, 4] mm
        """Has other poses rendered in place of those that wait, as many of them; False where that is too late."""
        return self._turn.give_to(poses, deadline)

    async def frames(self) -> RenderResult[S]:
        """Waits for them, once. Raises what RenderPool.render and Plan.renew raise."""
        for _ in range(MAX_SCENE_CHANGES):
            try:
                with scene_to_blame():
                    return await self._pool.frames(self._turn)
            except SceneChangedError:
                await self._plan.renew()
                plan, newest = self._plan, self._turn.request
                settings = _breathed(self._settings or plan.settings, plan)
                self.close()
                self._turn = self._pool.ask(replace(newest, settings=settings, version=plan.version))
        raise RenderFailed(f"scene {self._plan.scene!r} kept changing while it was being rendered", field="scene")

    def close(self) -> None:
        self._turn.close()

    def __enter__(self) -> PendingFrames[S]:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class Rendering:
    def __init__(
        self, pool: RenderPool, planner: RequestPlanner, life: Life, owners: Owners, limits: Limits, metrics: Metrics
    ) -> None:
        self.pool, self.planner, self.life, self.limits, self.metrics = pool, planner, life, limits, metrics
        self._owners = owners

    def require_frames(self) -> None:
        self.life.require_serving()
        if not self.pool.ready:
            raise NotReady("no render process is alive and gets on with its work at the moment")

    async def render(
        self,
        plan: Plan[S],
        poses: FloatArray,  # [C, 4, 4] mm, exact
        *,
        deadline: float | None,  # time.monotonic() in seconds
        priority: Priority = Priority.INTERACTIVE,
        begin_by: float | None = None,  # time.monotonic() in seconds; else it is refused
        destination: Destination | None = None,
        settings: S | None = None,  # in place of the plan's: a part of it
    ) -> RenderResult[S]:
        """Renders for the scene that is there by then. Raises what RenderPool.render and Plan.renew raise."""
        pending = self.ask(
            plan,
            poses,
            deadline=deadline,
            priority=priority,
            begin_by=begin_by,
            destination=destination,
            settings=settings,
        )
        with pending:
            return await pending.frames()

    def ask(
        self,
        plan: Plan[S],
        poses: FloatArray,  # [C, 4, 4] mm, exact
        *,
        deadline: float | None,  # time.monotonic() in seconds
        priority: Priority = Priority.INTERACTIVE,
        begin_by: float | None = None,  # likewise
        destination: Destination | None = None,
        settings: S | None = None,
    ) -> PendingFrames[S]:
        """As `render`, which waits for the frames: has them wait for their turn at once. Raises what RenderPool.ask
        raises, and SceneNotFound.
        """
        self.life.require_serving()
        mine = account()
        mine.target = plan.scene
        mine.frames += len(poses)
        if self._owners.hides(Kind.SCENE, plan.scene):  # since a stream began, for example
            raise SceneNotFound(f"there is no scene {plan.scene!r} any more", field="scene")
        request = RenderRequest(
            plan.scene,
            _breathed(settings or plan.settings, plan),
            poses,
            priority,
            deadline,
            plan.version,
            caller(),
            begin_by,
            destination,
        )
        return PendingFrames(self.pool, plan, request, settings)

    async def render_slice(
        self, plan: Plan[SliceView], pose: FloatArray, *, deadline: float | None
    ) -> RenderResult[SliceView]:
        """A slice at a pose [4, 4] mm, some rows at a time: frames of others go between.

        After a piece that had to wait, as where others ask, the next ones are smaller, though the slice takes longer.
        Rows that cost too much for one piece come in smaller ones, too. Raises FrameTooCostly where these would be more
        than MOST_PIECES, and what `render` raises.
        """
        view, numbers = plan.settings, numbers_of(plan.settings.field)
        most = rows = max(1, PIECE_PIXELS // view.width)
        first = 0
        pieces: list[RenderResult[SliceView]] = []
        while first < view.height:
            piece = replace(view, height=min(rows, view.height - first), encoding=numbers)
            place = pose.copy()
            place[:3, 3] += first * view.spacing_mm * pose[:3, 2]
            try:
                result = await self.render(plan, place[None], deadline=deadline, settings=piece)
            except FrameTooCostly as error:
                most = rows = piece.height // 2
                if view.height > MOST_PIECES * rows:
                    raise FrameTooCostly(
                        "the Gaussians are too wide for the size of this slice; ask for fewer pixels", field=error.field
                    ) from None
                continue
            if pieces and result.scene_sha256 != pieces[0].scene_sha256:
                pieces, first = [], 0
                continue
            pieces.append(result)
            first += piece.height
            is_crowded = result.queue_ms > CROWDED_QUEUE_MS
            rows = min(most, max(1, CROWDED_PIECE_PIXELS // view.width)) if is_crowded else most
        began = time.monotonic()
        data = await asyncio.to_thread(b"".join, [piece.data for piece in pieces])  # megabytes, as others' frames wait
        if view.encoding is Encoding.PNG:
            data = await asyncio.to_thread(_png_of, view, data)
        return replace(
            pieces[0],
            settings=view,
            poses=pose[None],
            data=data,
            queue_ms=sum(piece.queue_ms for piece in pieces),
            render_ms=sum(piece.render_ms for piece in pieces),
            encode_ms=1000 * (time.monotonic() - began),
        )


def _breathed(settings: S, plan: Plan[S]) -> S:
    """With the phase of this moment, where tissue breathes by the clock."""
    return cast(S, settings.breathed(plan.header.info.motion)) if isinstance(settings, Resolved) else settings


def _png_of(view: SliceView, data: bytes) -> bytes:
    values = np.frombuffer(data, numbers_of(view.field).pixel_type).reshape(view.height, view.width)
    return encoded_image(as_grey(values, view.field), Encoding.PNG)


@lru_cache(maxsize=256)
def _the_same(settings: Resolved) -> Resolved:
    """One object for equal settings, so that their picture is worked out once."""
    return settings
