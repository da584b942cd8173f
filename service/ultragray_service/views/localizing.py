"""Real frames looked for in scenes, as all front doors ask for it and tell of it."""

from __future__ import annotations

from dataclasses import dataclass

from ultragray.contract import described
from ultragray.errors import InvalidArgument, RenderFailed
from ultragray.geometry.probe import FloatArray
from ultragray.learn.localization.settings import LocalizationSettings
from ultragray.rendering.settings import Encoding, FrameSettings
from ultragray_service.access.audit import account
from ultragray_service.access.principals import caller
from ultragray_service.core.poses import MatrixRows
from ultragray_service.core.rendering import Plan, Rendering
from ultragray_service.core.scenes import scene_to_blame
from ultragray_workers.pool.messages import LocalizeResult, Priority, RenderRequest, SceneChangedError, Sought
from ultragray_workers.pool.pool import MAX_SCENE_CHANGES

FRAMES_OF_A_SEARCH = 100  # that a search counts as: it takes as long, at 512x512


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
    def of(cls, result: LocalizeResult, plan: Plan) -> Located:
        found = result.found
        in_base = None if plan.registration is None else plan.registration.flange_to_base(found.pose)
        return cls(
            scene=result.scene,
            scene_sha256=result.scene_sha256,
            renderer=result.renderer,
            pose=found.pose.tolist(),
            flange_to_base=None if in_base is None else in_base.tolist(),
            registration=plan.settings.registration,
            similarity=found.similarity,
            is_found=found.is_found,
            position_std_mm=found.position_std_mm,
            angle_std_deg=found.angle_std_deg,
            shift_mm=found.shift_mm,
            turn_deg=found.turn_deg,
            queue_ms=round(result.queue_ms, 3),
            search_ms=round(result.search_ms, 3),
        )


def sought_frame(image: bytes, height: int | None, width: int | None, settings: LocalizationSettings) -> Sought:
    if (height is None) != (width is None):
        raise InvalidArgument(
            "image_height and image_width go together: both for grey pixels, neither for a PNG file",
            field="image_height" if height is None else "image_width",
        )
    return Sought(image, None if height is None or width is None else (height, width), settings)


async def locate(
    rendering: Rendering,
    scene: str,
    sought: Sought,
    start: FloatArray,  # [4, 4] mm, exact
    deadline: float,
    registration: str | None,
) -> Located:
    """Where in a scene a frame was taken, looked for about `start` until the `deadline` (time.monotonic(), s).

    `registration` leads the start into the scene, and the found pose back.

    It waits behind frames of interactive callers. Cancelling ends it. Raises what RenderPool.localize and
    RequestPlanner.plan raise, and RateLimited.
    """
    rendering.life.require_serving()
    account().target = scene
    plan = await rendering.planner.plan(
        scene, FrameSettings(probe=sought.settings.probe), Encoding.UINT8, registration=registration
    )
    await rendering.limits.take_frames(FRAMES_OF_A_SEARCH, deadline)
    for _ in range(MAX_SCENE_CHANGES):
        asked = RenderRequest(
            plan.scene,
            sought,
            plan.placed(start)[None],
            Priority.BATCH,
            deadline,
            plan.version,
            caller(),
        )
        try:
            with scene_to_blame():
                result = await rendering.pool.localize(asked)
        except SceneChangedError:
            await plan.renew()
        else:
            rendering.metrics.observe_search(result)
            return Located.of(result, plan)
    raise RenderFailed(f"scene {plan.scene!r} kept changing while the frame was looked for", field="scene")
