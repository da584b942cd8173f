"""Scenes: listed, described, imported, downloaded, deleted, loaded."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, BinaryIO

from fastapi import APIRouter, Query
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.types import Receive, Scope, Send

from ultragray.contract import described, made_of
from ultragray.errors import InvalidArgument
from ultragray.files import file_sha256
from ultragray.learn.localization.settings import LocalizationSettings
from ultragray.learn.planning.settings import MAX_LISTED, PlanSettings
from ultragray.learn.report.sizes import CorrectionSizes
from ultragray.scene.info import SceneHeader
from ultragray_service.core.poses import check_pose_count, exact_poses
from ultragray_service.core.scene_points import (
    ALL_FIELDS,
    DEFAULT_POINTS,
    FIELDS,
    MAX_POINTS,
    MAX_POSES,
    even_selection,
)
from ultragray_service.core.scenes import DEFAULT_PAGE_SIZE, MAX_PAGE_SIZE, Scene, SceneLoaded, ScenePage
from ultragray_service.core.threads import PATIENCE_S
from ultragray_service.core.uploads import arrivals
from ultragray_service.http.accept import PNG, RAW
from ultragray_service.http.bodies import (
    EDITS,
    LABEL_MAP,
    LARGE_IMAGE,
    PAINTED_FRAMES,
    RECIPE_MAP,
    AssessBody,
    EditBody,
    LabelBody,
    LabelMapBody,
    LocalizeBody,
    PlanBody,
    RecipeBody,
    body_schema,
    read_json_body,
)
from ultragray_service.http.dependencies import (
    BINARY,
    NOT_MODIFIED,
    Answers,
    PageToken,
    SceneName,
    ServiceDep,
    answer,
    blocks_of,
    check_upload,
    finish_or_abandon,
    is_known,
    problems,
    revalidated,
)
from ultragray_service.http.routes.datasets import Private
from ultragray_service.views.poses import Assessments, Located, Planned, locate, next_views, sought_frame
from ultragray_workers.jobs.owners import Kind
from ultragray_workers.scene_names import SUFFIXES, base_name

router = APIRouter(prefix="/v1/scenes", tags=["scenes"])

PageSize = Annotated[int, Query(ge=1, le=MAX_PAGE_SIZE, description="Scenes on one page.")]


@router.get("", response_model_exclude_none=True, responses=problems(401, 422))
async def list_scenes(
    service: ServiceDep, page_size: PageSize = DEFAULT_PAGE_SIZE, page_token: PageToken = ""
) -> ScenePage:
    """The scenes by name. New files appear without a restart; one that cannot be read has an `error`."""
    return await service.scenes.page(page_size, page_token)


@router.get("/{scene}", responses=problems(401, 404, 422))
async def get_scene(service: ServiceDep, scene: SceneName) -> Scene:
    """Probe, bounds, centre, training poses and metrics; mm, in the frame of the training sweep."""
    return await service.scenes.get(scene)


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
    image = await asyncio.to_thread(_bytes_of, body.image)
    sought = sought_frame(image, body.image_height, body.image_width, made_of(LocalizationSettings, body))
    start = None if body.start is None else body.start.exact("start")
    work = locate(service.rendering, scene, sought, start, deadline, body.registration)
    return await finish_or_abandon(work, request.receive, deadline)


@router.post(
    "/{scene}:plan",
    openapi_extra=body_schema(PlanBody),
    responses=problems(401, 404, 413, 415, 422, 429, 500, 503, 504, 507),
)
async def plan_views(request: Request, service: ServiceDep, scene: SceneName) -> Planned:
    """Where to look next: poses in reach whose frames would teach the scene most, in an order to travel them."""
    body = await read_json_body(request, PlanBody, PlanBody.many_poses())
    deadline = service.planner.deadline(None if body.timeout_ms is None else body.timeout_ms / 1000)
    listed, poses = body.poses, None
    if listed is not None:
        check_pose_count(len(listed), MAX_LISTED)
        poses = await exact_poses(len(listed), lambda index: listed[index].exact(f"poses[{index}]"))
    work = next_views(
        service.rendering,
        scene,
        made_of(PlanSettings, body),
        deadline,
        poses=poses,
        view=None if body.view is None else body.view.exact("view"),
        start=None if body.start is None else body.start.exact("start"),
        registration=body.registration,
    )
    return await finish_or_abandon(work, request.receive, deadline)


def _bytes_of(text: str, field: str = "image") -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except ValueError:
        raise InvalidArgument(f"{field} must be base64", field=field) from None


@router.post("/{scene}:load", responses=problems(401, 403, 404, 422, 503, 507))
async def load_scene(service: ServiceDep, scene: SceneName) -> SceneLoaded:
    """Loads the scene into every worker ahead of its first frame (rendering also loads on demand)."""
    return await service.scenes.load(scene)


@router.post("/{scene}:unload", responses=problems(401, 403, 404, 422, 503))
async def unload_scene(service: ServiceDep, scene: SceneName) -> SceneLoaded:
    """Frees the scene's memory; no error where it is not loaded."""
    return await service.scenes.unload(scene)


_LABELLED: Answers = problems(401, 403, 404, 409, 413, 415, 422, 429, 500, 503, 504, 507)


@router.post("/{scene}:label", status_code=201, openapi_extra=body_schema(LabelBody), responses=_LABELLED)
async def label_scene(request: Request, service: ServiceDep, scene: SceneName) -> Scene:
    """Labels the Gaussians of a scene by frames that somebody painted on. The scene itself stays as it is."""
    body = await read_json_body(request, LabelBody, PAINTED_FRAMES)
    frames = [
        (one.pose.exact(f"frames[{index}].pose"), _bytes_of(one.labels, f"frames[{index}].labels"))
        for index, one in enumerate(body.frames)
    ]
    work = service.edits.label_by_frames(scene, body, frames, body.probe, body.registration)
    return await finish_or_abandon(work, request.receive, time.monotonic() + PATIENCE_S)


@router.post("/{scene}:label-by-map", status_code=201, openapi_extra=body_schema(LabelMapBody), responses=_LABELLED)
async def label_scene_by_map(request: Request, service: ServiceDep, scene: SceneName) -> Scene:
    """Labels the Gaussians of a scene by a NIfTI label map. The scene itself stays as it is."""
    body = await read_json_body(request, LabelMapBody, LABEL_MAP)
    nifti = await asyncio.to_thread(_bytes_of, body.label_map, "label_map")
    work = service.edits.label_by_map(scene, body, nifti, body.registration)
    return await finish_or_abandon(work, request.receive, time.monotonic() + PATIENCE_S)


@router.post("/{scene}:edit", status_code=201, openapi_extra=body_schema(EditBody), responses=_LABELLED)
async def edit_scene(request: Request, service: ServiceDep, scene: SceneName) -> Scene:
    """Moves, cuts, merges, relabels or thins a scene, or inserts bodies, as a new scene; the scene stays as it is."""
    body = await read_json_body(request, EditBody, EDITS)
    work = service.edits.edit(scene, body)
    return await finish_or_abandon(work, request.receive, time.monotonic() + PATIENCE_S)


@router.post(":from-labels", status_code=201, openapi_extra=body_schema(RecipeBody), responses=_LABELLED)
async def make_scene(request: Request, service: ServiceDep) -> Scene:
    """Makes a scene that nobody recorded, from a label map or shapes of tissue. Its labels are all in `made_labels`."""
    body = await read_json_body(request, RecipeBody, RECIPE_MAP)
    return await finish_or_abandon(service.edits.make(body), request.receive, time.monotonic() + PATIENCE_S)


@dataclass(frozen=True)
class ScenePoses:
    """Training poses of a scene, evenly taken."""

    poses: list[list[float]] = described("As tracked, without the tracker's noise: 16 numbers each, row by row, mm.")
    rest_poses: list[list[float]] | None = described(
        "Where the tissue at rest looks as it does from `poses`: those that the scene was trained on. null: `poses`.",
        None,
    )
    shift_mm: list[float] | None = described(
        "How far each was moved from where the tracker had it to where the scene was trained on it; null: none was.",
        None,
    )
    turn_deg: list[float] | None = described("And turned.", None)


PointLimit = Annotated[int, Query(ge=1, le=MAX_POINTS, description="Gaussians at most.")]
PointFields = Annotated[
    list[str] | None,
    Query(
        max_length=len(ALL_FIELDS),
        description=f"What is told of each, in the order asked for; the first {len(FIELDS)} where nothing is asked "
        f"for: {', '.join(ALL_FIELDS)}.",
    ),
]
_POINTS = (
    answer(
        "The length of the JSON that follows (uint32, little endian), the JSON with `count`, `fields` and `total`, "
        "then float32 [count, fields] from a multiple of 8 bytes.",
        RAW,
    )
    | NOT_MODIFIED
)
_POSES: Answers = {200: {"model": ScenePoses}, **NOT_MODIFIED}
_THUMBNAIL = answer("8-bit grey, square pixels, 128 on the longer side.", PNG) | NOT_MODIFIED
_FILE = answer("The scene file.", RAW)
_IMPORT: dict[str, Any] = {
    "requestBody": {"required": True, "description": "A scene file (.ugr).", "content": {RAW: BINARY}}
}


@router.get("/{scene}/gaussians", response_class=Response, responses=_POINTS | problems(401, 404, 422))
async def get_gaussians(
    request: Request,
    service: ServiceDep,
    scene: SceneName,
    limit: PointLimit = DEFAULT_POINTS,
    fields: PointFields = None,
) -> Response:
    """Gaussians as points: position, intensity, transmittance and size, or `fields`; always the same even selection."""
    version = (await service.catalog.version(scene)).tag
    return await revalidated(request, version, partial(service.catalog.points, scene, limit, fields or FIELDS), RAW)


@router.get("/{scene}/training-poses", response_class=Response, responses=_POSES | problems(401, 404, 422))
async def get_training_poses(request: Request, service: ServiceDep, scene: SceneName) -> Response:
    """The poses that the scene was trained from and those it was trained on, at most 10,000, evenly taken."""

    async def poses() -> bytes:
        return await asyncio.to_thread(_poses_json, await service.catalog.header(scene))

    return await revalidated(request, (await service.catalog.version(scene)).tag, poses, "application/json")


@router.get(
    "/{scene}/thumbnail.png",
    response_class=Response,
    responses=_THUMBNAIL | problems(401, 404, 422, 500, 503, 504, 507),
)
async def get_thumbnail(request: Request, service: ServiceDep, scene: SceneName) -> Response:
    """A small frame from the middle of the training sweep; made at the first request, without loading the scene."""
    service.life.require_serving()
    key = await service.thumbnails.key(scene)
    return await revalidated(request, f"{key}-thumbnail", partial(service.thumbnails.png, scene, key), PNG)


class OpenFileResponse(FileResponse):
    """A file that is open already: one version of it, whatever takes its name while a client reads."""

    def __init__(self, file: BinaryIO, *, filename: str, headers: Mapping[str, str] | None = None) -> None:
        self._file = file
        path, status = f"/dev/fd/{file.fileno()}", os.fstat(file.fileno())
        super().__init__(path, headers=headers, media_type=RAW, filename=filename, stat_result=status)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self._file:
            await super().__call__(scope, receive, send)


def _file_answer(request: Request, file: BinaryIO, filename: str, headers: Mapping[str, str]) -> Response:
    """The answer to a GET of an open file; 304 where the client has what its ETag names."""
    headers = {"Cache-Control": "private, no-cache", **headers}
    answer = OpenFileResponse(file, filename=filename, headers=headers)
    etag = answer.headers["etag"]
    if not is_known(request.headers, etag):
        return answer
    file.close()
    return Response(status_code=304, headers={**headers, "ETag": etag})


@router.get("/{scene}/file", response_class=FileResponse, responses=_FILE | NOT_MODIFIED | problems(401, 404, 422))
async def download_scene(request: Request, service: ServiceDep, scene: SceneName) -> Response:
    """Downloads the scene file. Ranges are answered, so that a download can go on."""
    header = await service.catalog.header(scene)
    file = await asyncio.to_thread(service.scene_store.open, scene)
    return _file_answer(request, file, f"{base_name(scene)}{SUFFIXES[header.is_compressed]}", {})


@router.get(
    "/{scene}/file.ugz",
    response_class=FileResponse,
    responses=_FILE | NOT_MODIFIED | problems(401, 404, 422, 500, 503, 504, 507),
)
async def download_compressed_scene(request: Request, service: ServiceDep, scene: SceneName) -> Response:
    """Downloads the scene, compressed: about a fifth of the bytes, coarse first. Ranges are answered.

    It is made at the first request.
    """
    service.life.require_serving()
    file = await service.compressed.open(scene)
    sha256 = await asyncio.to_thread(file_sha256, f"/dev/fd/{file.fileno()}")
    return _file_answer(request, file, f"{base_name(scene)}{SUFFIXES[True]}", {"ETag": f'"{sha256}"'})


@router.put(
    "/{scene}",
    status_code=201,
    openapi_extra=_IMPORT,
    responses=problems(401, 403, 409, 413, 415, 422, 429, 500, 503, 504, 507),
)
async def import_scene(request: Request, service: ServiceDep, scene: SceneName, private: Private = False) -> Scene:
    """Takes a scene file in and serves it. It is checked first, and appears whole or not at all."""
    service.life.require_serving()
    settings = service.settings
    check_upload(request, settings.max_dataset_bytes, "a scene file")
    with arrivals(service.life.draining, settings.upload_idle_timeout_s) as arrival:
        async with service.imports.receive(scene, blocks_of(request, arrival)) as received:
            accepting = service.imports.accept(received, scene, private=private)
            header = await finish_or_abandon(accepting, request.receive, time.monotonic() + PATIENCE_S)
    return Scene.of(scene, header, 0, service.owners.known(Kind.SCENE, scene))


@router.delete("/{scene}", status_code=204, responses=problems(401, 403, 404, 422, 503))
async def delete_scene(service: ServiceDep, scene: SceneName) -> None:
    """Deletes a scene that was imported or that a job made, and frees its memory. Others are not the service's."""
    service.life.require_serving()
    await service.imports.delete(scene)
    await service.pool.forget(scene)


def _poses_json(header: SceneHeader) -> bytes:
    chosen = even_selection(len(header.training_poses), MAX_POSES)
    sizes = CorrectionSizes.of(header)
    fields = {
        "poses": header.training_poses.reshape(-1, 16),
        "rest_poses": None if header.rest_poses is None else header.rest_poses.reshape(-1, 16),
        "shift_mm": None if sizes is None else sizes.shift_mm,
        "turn_deg": None if sizes is None else sizes.turn_deg,
    }
    return json.dumps({name: None if one is None else one[chosen].tolist() for name, one in fields.items()}).encode()
