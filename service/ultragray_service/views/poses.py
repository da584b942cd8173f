"""What a scene says of poses, and where it finds real frames, as all front doors ask for it and tell of it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ultragray.contract import described, made_of
from ultragray.errors import InvalidArgument, RenderFailed
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.localization.pixels import EncodedFrame
from ultragray.learn.localization.settings import Localization, LocalizationSettings, SearchKind
from ultragray.learn.planning.settings import PlanSettings, ViewPlan
from ultragray.rendering.settings import Encoding, FrameSettings
from ultragray.scene.confidence import Assessor, Extrapolation
from ultragray.scene.info import SceneHeader
from ultragray_service.access.audit import account
from ultragray_service.access.principals import caller
from ultragray_service.core.poses import MatrixRows
from ultragray_service.core.previews import FRAMES_OF_A_SEARCH
from ultragray_service.core.registrations import Registrations
from ultragray_service.core.rendering import Plan, Rendering
from ultragray_service.core.scenes import SceneCatalog, scene_to_blame
from ultragray_workers.pool.messages import (
    NextViews,
    Priority,
    RenderRequest,
    SceneChangedError,
    Search,
    SearchResult,
    Sought,
)
from ultragray_workers.pool.pool import MAX_SCENE_CHANGES


@dataclass(frozen=True)
class Assessments:
    """Of poses, in their order."""

    extrapolations: list[Extrapolation] = described("supported_share is null: only a rendered frame tells it.")


class Assessing:
    """Assesses the poses of one caller at a time, beside the event loop."""

    def __init__(self, catalog: SceneCatalog, registrations: Registrations) -> None:
        self._catalog, self._registrations = catalog, registrations
        self._turn = asyncio.Lock()

    async def assess(
        self,
        scene: str,
        poses: FloatArray,  # [C, 4, 4] mm, exact
        probe: Probe | None,
        registration: str | None,
    ) -> Assessments:
        """The extrapolation of each pose of a probe (None: the scene's own), led into the scene by a registration.

        Raises SceneNotFound, SceneFileInvalid, RegistrationNotFound, and InvalidProbe where no probe is known.
        """
        header = await self._catalog.header(scene)
        if registration is not None:
            poses = (await self._registrations.of_scene(registration, scene)).probe_to_scene(poses)
        async with self._turn:
            return Assessments(await asyncio.to_thread(_assess, header, poses, probe))


def _assess(header: SceneHeader, poses: FloatArray, probe: Probe | None) -> list[Extrapolation]:
    return Assessor(header.info, header.training_poses).assess(poses, probe)


@dataclass(frozen=True, eq=False, kw_only=True)
class Located:
    """Where a real frame was taken, and how certain that is."""

    scene: str = described("Name.")
    scene_sha256: str = described("Of the scene file.")
    renderer: str = described("Name, version and backend of the renderer.")
    pose: MatrixRows = described("Probe to scene, mm. Not to be used where is_found is false.")
    flange_to_base: MatrixRows | None = described(
        "The same as the pose of the registration, flange to base or marker to tracker, mm; null: none was named.", None
    )
    registration: str | None = described("That led the start into the scene; null: none, it was sent as it is.", None)
    similarity: float = described("Correlation of the structures of the frame and of the scene there, -1 to 1.")
    is_found: bool = described("Whether the similarity is as high as only the right place has it.")
    position_std_mm: tuple[float, float, float] = described(
        "Standard deviations along the probe's lateral, elevation and axial axis; they hold where is_found does."
    )
    angle_std_deg: tuple[float, float, float] = described("About these axes, through the middle of the image.")
    shift_mm: float = described("Of the middle of the image, from the start.")
    turn_deg: float = described("Of the image, from the start.")
    queue_ms: float = described("Waiting time.")
    search_ms: float = described("Time of the search.")

    @classmethod
    def of(cls, result: SearchResult[Localization], plan: Plan) -> Located:
        match = result.found
        in_base = None if plan.registration is None else plan.registration.flange_to_base(match.pose)
        return made_of(
            cls,
            match,
            result,
            pose=match.pose.tolist(),
            flange_to_base=None if in_base is None else in_base.tolist(),
            registration=plan.settings.registration,
            queue_ms=round(result.queue_ms, 3),
            search_ms=round(result.search_ms, 3),
        )


def sought_frame(image: bytes, height: int | None, width: int | None, settings: LocalizationSettings) -> Sought:
    EncodedFrame(image, height, width)  # its check
    return Sought(image, settings, None if height is None or width is None else (height, width))


async def locate(
    rendering: Rendering,
    scene: str,
    sought: Sought,
    start: FloatArray | None,  # [4, 4] mm, exact; None: anywhere
    deadline: float,
    registration: str | None,
) -> Located:
    """Where in a scene a frame was taken, looked for about `start` until the `deadline` (time.monotonic(), s).

    `registration` leads the start into the scene, and the found pose back.

    Raises InvalidArgument where a start is needed, and what `_searched` raises.
    """
    kind = sought.settings.search
    if start is None and kind is not SearchKind.ANYWHERE:
        raise InvalidArgument("start is required, unless search is anywhere", field="start")
    about = np.eye(4) if start is None else start  # anywhere: it counts for nothing
    frames = FRAMES_OF_A_SEARCH // 10 if kind is SearchKind.TRACK else FRAMES_OF_A_SEARCH
    result, plan = await _searched(
        rendering,
        scene,
        sought.settings.probe,
        lambda plan: (sought, plan.placed(about)),
        deadline,
        registration,
        frames,
    )
    rendering.metrics.observe_search(result)
    return Located.of(result, plan)


async def _searched(
    rendering: Rendering,
    scene: str,
    probe: Probe | None,
    search: Callable[[Plan], tuple[Search, FloatArray]],
    deadline: float,
    registration: str | None,
    frames: int = FRAMES_OF_A_SEARCH,
) -> tuple[SearchResult[Any], Plan]:
    """What a search, and the pose that it starts from, come to until the `deadline` (time.monotonic(), s).

    It counts as so many frames of the caller's limit.
    It waits behind frames of interactive callers. Cancelling ends it. Raises what RenderPool.search and
    RequestPlanner.plan raise, and RateLimited.
    """
    rendering.life.require_serving()
    account().target = scene
    plan = await rendering.planner.plan(scene, FrameSettings(probe=probe), Encoding.UINT8, registration=registration)
    await rendering.limits.take_frames(frames, deadline)
    for _ in range(MAX_SCENE_CHANGES):
        what, start = search(plan)
        request = RenderRequest(plan.scene, what, start[None], Priority.BATCH, deadline, plan.version, caller())
        try:
            with scene_to_blame():
                result = await rendering.pool.search(request)
        except SceneChangedError:
            await plan.renew()
        else:
            return result, plan
    raise RenderFailed(f"scene {plan.scene!r} kept changing while it was searched", field="scene")


@dataclass(frozen=True, kw_only=True)
class PlannedView:
    """A view of a plan."""

    pose: MatrixRows = described("Probe to scene, mm.")
    flange_to_base: MatrixRows | None = described(
        "The same as the pose of the registration; null: none was named.", None
    )
    gain: float = described("What it is expected to add to what is wanted, beside the views of lower ranks.")
    rank: int = described("0: it was chosen first, as it gains most.")


@dataclass(frozen=True, eq=False, kw_only=True)
class Planned:
    """Where to look next."""

    scene: str = described("Name.")
    scene_sha256: str = described("Of the scene file.")
    views: list[PlannedView] = described(
        "In an order to travel them; fewer than were asked for where no other would gain anything."
    )
    before: float = described("What is wanted, as the scene has it: a share, 0 to 1; of confidence an MS-SSIM.")
    after: float = described("And as it is expected to be with the views.")
    path_mm: float = described("Length of the way through the views, from the start where one was given.")
    registration: str | None = described("That led the poses into the scene; null: none.", None)
    queue_ms: float = described("Waiting time.")
    plan_ms: float = described("Time of the search.")

    @classmethod
    def of(cls, result: SearchResult[ViewPlan], plan: Plan) -> Planned:
        outcome, registration = result.found, plan.registration
        views = [
            PlannedView(
                pose=pose.tolist(),
                flange_to_base=None if registration is None else registration.flange_to_base(pose).tolist(),
                gain=gain,
                rank=rank,
            )
            for pose, gain, rank in zip(outcome.poses, outcome.gains.tolist(), outcome.ranks.tolist(), strict=True)
        ]
        return made_of(
            cls,
            outcome,
            result,
            views=views,
            registration=plan.settings.registration,
            queue_ms=round(result.queue_ms, 3),
            plan_ms=round(result.search_ms, 3),
        )


async def next_views(
    rendering: Rendering,
    scene: str,
    settings: PlanSettings,
    deadline: float,
    *,
    poses: FloatArray | None,  # [C, 4, 4] mm, exact: all that is in reach
    view: FloatArray | None,  # [4, 4] mm, exact
    start: FloatArray | None,  # [4, 4] mm, exact
    registration: str | None,
) -> Planned:
    """Where to look next in a scene; `registration` leads all poses into it, and the planned ones back.

    Raises what `_searched` raises.
    """

    def search(plan: Plan) -> tuple[Search, FloatArray]:
        placed = [None if one is None else plan.placed(one) for one in (poses, view, start)]
        data = b"" if placed[0] is None else placed[0].tobytes()
        return NextViews(data, settings, placed[1], placed[2]), np.eye(4)

    result, plan = await _searched(rendering, scene, settings.probe, search, deadline, registration)
    return Planned.of(result, plan)
