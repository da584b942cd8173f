"""Frames for poses and slices on planes, one request each. The Accept header chooses the form; the workers encode."""

from __future__ import annotations

import asyncio
import json
from dataclasses import fields
from functools import lru_cache
from typing import Any

import numpy as np
from fastapi import APIRouter
from starlette.requests import Request
from starlette.responses import Response

from ultragray.errors import InvalidArgument
from ultragray.exchange.exports.exporter import ExportHeader
from ultragray.exchange.exports.formats import FORMATS, check_format, export_bytes, exporter_class
from ultragray.files import npy_bytes
from ultragray.rendering.outputs import OUTPUTS
from ultragray.rendering.settings import Encoding, Resolved, SettingsUsed, settings_used
from ultragray.rendering.volumes import SliceSettings, SliceView
from ultragray_service.core.poses import SliceFacts, exact_poses
from ultragray_service.http.accept import DICOM, JPEG, NPY, NPZ, PNG, RAW, choose, choose_of_slice
from ultragray_service.http.bodies import RenderBody, body_schema, read_json_body
from ultragray_service.http.dependencies import (
    RENDER_EXAMPLES,
    SCENE_NAME,
    SLICE_EXAMPLES,
    SceneName,
    ServiceDep,
    answer,
    finish_or_abandon,
    problems,
)
from ultragray_service.service import Service
from ultragray_service.telemetry.metrics import STAGES
from ultragray_workers.pool.messages import Priority, RenderResult

router = APIRouter(prefix="/v1/scenes", tags=["render"])


def _header_of(setting: str) -> str:
    """The header of a setting as used: a text as it is, numbers, lists with commas, else JSON."""
    return f"X-Ultragray-{setting.replace('_', '-').title()}"


RENDER_HEADERS = {
    "X-Ultragray-Scene": "Name of the scene.",
    "X-Ultragray-Scene-Sha256": "SHA-256 of the scene file.",
    "X-Ultragray-Renderer": "Name, version and backend of the renderer.",
    "X-Ultragray-Shape": "Outputs, poses, height, width: 1,1,512,512.",
    "X-Ultragray-Dtype": "uint8, float32 or float16 (little endian).",
    "X-Ultragray-Pose": "One pose only: the 4x4 matrix that was used, JSON. Of many, npz holds `poses`.",
    "X-Ultragray-Confidence": "Of each pose, with commas; empty where the scene cannot tell.",
    "X-Ultragray-Extrapolation": "One pose only: distance_mm, angle_deg, confidence, supported_share, contact_share, "
    "indentation_mm, force_n, JSON. Of many, npz holds them.",
    **{_header_of(one.name): one.metadata["description"] for one in fields(SettingsUsed)},
    "X-Ultragray-Queue-Ms": "Waiting time.",
    "X-Ultragray-Render-Ms": "Render time of the batch that the poses were in.",
    "X-Ultragray-Encode-Ms": "Encoding time.",
    "X-Request-Id": "Id of the request: the one that was sent, or a new one.",
    "Server-Timing": "The three times, for browsers.",
}

_OPENAPI: dict[str, Any] = {
    "parameters": [{"name": "scene", "in": "path", "required": True, **SCENE_NAME}],
    **body_schema(RenderBody, RENDER_EXAMPLES),
}
_ANSWER = answer(
    "The frames. image/png and image/jpeg: one pose, one output. application/octet-stream (parameter dtype=uint8, "
    "float32 or float16): the outputs one after another, each [C, H, W]. application/x-npz holds one float32 array "
    "[C, H, W] per output, `poses` [C, 4, 4], and the strings scene, scene_sha256 and renderer. application/dicom: an "
    "ultrasound image of bmode, multi-frame of several poses, true to scale: fans are scan-converted. `*/*` gives PNG "
    "where it can hold the request, else npz.",
    *(PNG, JPEG, RAW, NPZ, DICOM),
    headers=RENDER_HEADERS,
)


@router.post(
    "/{scene}/render",
    response_class=Response,
    openapi_extra=_OPENAPI,
    responses=_ANSWER | problems(401, 404, 406, 413, 415, 422, 429, 500, 501, 503, 504, 507),
)
async def render(request: Request) -> Response:
    """One frame per pose and output. Poses: probe to scene, in mm, in the frame of the training sweep."""
    # Taken from the request here, because FastAPI needs 0.07 ms to hand them over.
    service: Service = request.app.state.service
    scene: str = request.path_params["scene"]
    planner = service.planner
    body = await read_json_body(request, RenderBody, RenderBody.many_poses(planner.max_poses_at_once))
    deadline = planner.deadline(None if body.timeout_ms is None else body.timeout_ms / 1000)
    begin_by = None if body.max_queue_ms is None else planner.deadline(body.max_queue_ms / 1000)
    poses = body.poses_by_path(planner.max_poses_at_once)
    choice = choose(
        request.headers.get("accept", ""),
        frames=len(poses),
        outputs=len(body.outputs),
        dtype=body.dtype,
        lossless=any(OUTPUTS[name].is_numbers for name in body.outputs),
    )
    is_dicom = choice.media_type == DICOM
    if is_dicom:
        check_format("dicom", body.outputs, body.dtype)
        body.check_stored(len(poses))
        await asyncio.to_thread(exporter_class, "dicom")  # refused before anything is rendered
    elif body.frame_times_ms is not None or body.annotations:
        field = "annotations" if body.annotations else "frame_times_ms"
        raise InvalidArgument(f"{field} can be told by {DICOM} alone, and Accept asks for another type", field=field)

    def complete(settings: Resolved) -> Resolved:
        return planner.check_pixels(FORMATS["dicom"].shown(settings) if is_dicom else settings, len(poses))

    plan = await planner.plan(scene, body, choice.encoding, registration=body.registration, complete=complete)
    sent_poses = await exact_poses(len(poses), lambda index: poses[index][1].exact(poses[index][0]))
    exact = plan.placed(sent_poses)
    priority = Priority.INTERACTIVE if body.poses is None else Priority.BATCH

    counted = service.limits.take_frames(len(exact), deadline)
    await (counted if len(exact) == 1 else finish_or_abandon(counted, request.receive, deadline))  # many take seconds
    with service.rendering.ask(plan, exact, priority=priority, deadline=deadline, begin_by=begin_by) as pending:
        result = await finish_or_abandon(pending.frames(), request.receive, deadline)
    data = await asyncio.to_thread(_dicom_of, result, body) if is_dicom else result.data
    return Response(data, 200, render_headers(result), choice.media_type)


def _dicom_of(result: RenderResult, body: RenderBody) -> bytes:
    settings = result.settings
    header = ExportHeader(
        settings,
        "uint8",
        result.poses,
        result.scene,
        result.scene_sha256,
        result.renderer,
        body.frame_times_ms,
        body.annotations,
    )
    frames = {"bmode": np.frombuffer(result.data, np.uint8).reshape(header.shape)}
    return export_bytes("dicom", header, frames, result.extrapolations)


def render_headers(result: RenderResult) -> dict[str, str]:
    settings, poses = result.settings, result.poses
    times = {stage: f"{getattr(result, f'{stage}_ms'):.3f}" for stage in STAGES}
    confidences = ["" if one.confidence is None else f"{one.confidence:.3f}" for one in result.extrapolations]
    headers = {
        "X-Ultragray-Scene": result.scene,
        "X-Ultragray-Scene-Sha256": result.scene_sha256,
        "X-Ultragray-Renderer": result.renderer,
        "X-Ultragray-Shape": f"{len(settings.outputs)},{len(poses)},{settings.picture.height},{settings.picture.width}",
        "X-Ultragray-Confidence": ",".join(confidences),
        "Server-Timing": ", ".join([f"{stage};dur={milliseconds}" for stage, milliseconds in times.items()]),
        **{f"X-Ultragray-{stage.title()}-Ms": milliseconds for stage, milliseconds in times.items()},
        **_settings_headers(settings),
    }
    if len(poses) == 1:
        headers["X-Ultragray-Pose"] = json.dumps(poses[0].tolist())
        headers["X-Ultragray-Extrapolation"] = json.dumps(vars(result.extrapolations[0]))
    return headers


@lru_cache(maxsize=256)
def _settings_headers(settings: Resolved) -> dict[str, str]:
    texts = {"dtype": settings.encoding.pixel_type.name, **settings_used(settings).texts()}
    return {_header_of(name): text for name, text in texts.items()}


SLICE_HEADERS = {
    "X-Ultragray-Scene": "Name of the scene.",
    "X-Ultragray-Scene-Sha256": "SHA-256 of the scene file.",
    "X-Ultragray-Shape": "Height, width: 120,80.",
    "X-Ultragray-Dtype": "float32 (little endian), of labels and image/png uint8.",
    "X-Ultragray-Pixel-To-Scene": "4x4 matrix from (column, row, k, 1), from 0 at pixels' centres, to mm, JSON.",
    "Server-Timing": "Waiting, sampling and encoding time, for browsers.",
}
_SLICE_ANSWER = answer(
    "The slice, [H, W]. image/png: grey, 255 at 1 (attenuation: at the largest value of the slice); labels keep their "
    "numbers. application/x-npy and application/octet-stream: the values, row by row. `*/*` gives PNG.",
    *(PNG, NPY, RAW),
    headers=SLICE_HEADERS,
)


@router.post(
    "/{scene}:slice",
    response_class=Response,
    openapi_extra=body_schema(SliceSettings, SLICE_EXAMPLES),
    responses=_SLICE_ANSWER | problems(401, 404, 406, 413, 415, 422, 429, 500, 503, 504, 507),
)
async def render_slice(request: Request, service: ServiceDep, scene: SceneName) -> Response:
    """A field of the scene on any plane, without a probe. It waits and counts as a frame does."""
    media_type = choose_of_slice(request.headers.get("accept", ""))
    settings = await read_json_body(request, SliceSettings)
    deadline = service.planner.deadline(None)
    encoding = Encoding.PNG if media_type == PNG else settings.numbers
    plan = await service.planner.plan_slice(scene, settings, encoding)

    async def rendered() -> RenderResult[SliceView]:
        await service.limits.take_frames(1, deadline)
        return await service.rendering.render_slice(plan, settings.pose(), deadline=deadline)

    result = await finish_or_abandon(rendered(), request.receive, deadline)
    data = _npy_of(result) if media_type == NPY else result.data
    return Response(data, 200, _headers(SliceFacts.of(result)), media_type)


def _npy_of(result: RenderResult[SliceView]) -> bytes:
    view = result.settings
    pixels = np.frombuffer(result.data, view.encoding.pixel_type).reshape(view.height, view.width)
    return npy_bytes(pixels)


def _headers(facts: SliceFacts) -> dict[str, str]:
    return {
        "X-Ultragray-Scene": facts.scene,
        "X-Ultragray-Scene-Sha256": facts.scene_sha256,
        "X-Ultragray-Shape": f"{facts.height},{facts.width}",
        "X-Ultragray-Dtype": facts.encoding.pixel_type.name,
        "X-Ultragray-Pixel-To-Scene": json.dumps(facts.pixel_to_scene.tolist()),
        "Server-Timing": ", ".join(f"{stage};dur={getattr(facts, f'{stage}_ms')}" for stage in STAGES),
    }
