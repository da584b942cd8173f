"""The scenes of the data folder."""

from __future__ import annotations

import asyncio
import base64
from typing import Annotated

from fastapi import APIRouter, Query
from starlette.requests import Request

from ultragray.errors import InvalidArgument
from ultragray.learn.localization.settings import LocalizationSettings
from ultragray_service.core import scenes
from ultragray_service.core.catalog import DEFAULT_PAGE_SIZE, MAX_PAGE_SIZE
from ultragray_service.core.poses import check_pose_count, exact_poses
from ultragray_service.core.scenes import Scene, SceneLoaded, ScenePage
from ultragray_service.http.deps import SceneName, ServiceDep, problems
from ultragray_service.http.disconnect import finish_or_abandon
from ultragray_service.http.reading.bodies import LARGE_IMAGE, AssessBody, LocalizeBody
from ultragray_service.http.reading.json_body import body_schema, read_json_body
from ultragray_service.views.assessments import Assessments
from ultragray_service.views.localizing import Located, locate, sought_frame

router = APIRouter(prefix="/v1/scenes", tags=["scenes"])

PageSize = Annotated[int, Query(ge=1, le=MAX_PAGE_SIZE, description="Scenes on one page.")]
PageToken = Annotated[str, Query(description="next_page_token of the page before.")]


@router.get("", response_model_exclude_none=True, responses=problems(401, 422))
async def list_scenes(
    service: ServiceDep, page_size: PageSize = DEFAULT_PAGE_SIZE, page_token: PageToken = ""
) -> ScenePage:
    """The scenes by name. New files appear without a restart; one that cannot be read has an `error`."""
    return await scenes.scene_page(service, page_size, page_token)


@router.get("/{scene}", responses=problems(401, 404, 422))
async def get_scene(service: ServiceDep, scene: SceneName) -> Scene:
    """Probe, bounds, centre, training poses and metrics; mm, in the frame of the training sweep."""
    return await scenes.scene(service, scene)


@router.post("/{scene}:assess", openapi_extra=body_schema(AssessBody), responses=problems(401, 404, 413, 415, 422))
async def assess_poses(request: Request, service: ServiceDep, scene: SceneName) -> Assessments:
    """How far frames at these poses would extrapolate, and how far to trust them, without rendering any."""
    most = service.planner.max_poses
    body = await read_json_body(request, AssessBody, AssessBody.many_poses(most))
    check_pose_count(len(body.poses), most)
    poses = await exact_poses(len(body.poses), lambda index: body.poses[index].exact(f"poses[{index}]"))
    return await service.assessing.assess(scene, poses, body.probe, body.registration)


@router.post(
    "/{scene}:localize",
    openapi_extra=body_schema(LocalizeBody),
    responses=problems(401, 404, 413, 415, 422, 429, 500, 503, 504, 507),
)
async def localize(request: Request, service: ServiceDep, scene: SceneName) -> Located:
    """Where in the scene a real frame was taken, looked for about `start`."""
    body = await read_json_body(request, LocalizeBody, LARGE_IMAGE)
    deadline = service.planner.deadline(None if body.timeout_ms is None else body.timeout_ms / 1000)
    asked = LocalizationSettings(probe=body.probe, within_mm=body.within_mm, within_deg=body.within_deg)
    image = await asyncio.to_thread(_bytes_of, body.image)
    sought = sought_frame(image, body.image_height, body.image_width, asked)
    work = locate(service, scene, sought, body.start.exact("start"), deadline, body.registration)
    return await finish_or_abandon(work, request.receive, deadline)


def _bytes_of(text: str) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except ValueError:
        raise InvalidArgument("image must be base64", field="image") from None


@router.post("/{scene}:load", responses=problems(401, 403, 404, 422, 503, 507))
async def load_scene(service: ServiceDep, scene: SceneName) -> SceneLoaded:
    """Loads the scene into every worker ahead of its first frame (rendering also loads on demand)."""
    return SceneLoaded.of(scene, await service.load(scene))


@router.post("/{scene}:unload", responses=problems(401, 403, 404, 422, 503))
async def unload_scene(service: ServiceDep, scene: SceneName) -> SceneLoaded:
    """Frees the scene's memory; no error where it is not loaded."""
    return SceneLoaded.of(scene, await service.unload(scene))
