"""Slices of a scene on any plane. The Accept header chooses the form."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
from fastapi import APIRouter
from starlette.requests import Request
from starlette.responses import Response

from ultragray.settings import Encoding
from ultragray.volumes.plane import SliceSettings, SliceView
from ultragray_service.core.frames import SliceFacts
from ultragray_service.http.deps import SceneName, ServiceDep, problems
from ultragray_service.http.disconnect import finish_or_abandon
from ultragray_service.http.examples import SLICE_EXAMPLES
from ultragray_service.http.reading.accept import NPY, PNG, RAW, choose_of_slice
from ultragray_service.http.reading.json_body import body_schema, read_json_body
from ultragray_service.telemetry.statistics import STAGES
from ultragray_workers.pool.types import RenderResult

router = APIRouter(prefix="/v1/scenes", tags=["render"])

SLICE_HEADERS = {
    "X-Ultragray-Scene": "Name of the scene.",
    "X-Ultragray-Scene-Sha256": "SHA-256 of the scene file.",
    "X-Ultragray-Shape": "Height, width: 120,80.",
    "X-Ultragray-Dtype": "float32 (little endian), of labels and image/png uint8.",
    "X-Ultragray-Pixel-To-Scene": "4x4 matrix from (column, row, k, 1), from 0 at pixels' centres, to mm, JSON.",
    "Server-Timing": "Waiting, sampling and encoding time, for browsers.",
}
_BINARY = {"schema": {"type": "string", "format": "binary"}}
_ANSWER: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The slice, [H, W]. image/png: grey, 255 at 1 (attenuation: at the largest value of the slice); "
        "labels keep their numbers. application/x-npy and application/octet-stream: the values, row by row. `*/*` "
        "gives PNG.",
        "content": {PNG: _BINARY, NPY: _BINARY, RAW: _BINARY},
        "headers": {name: {"description": text, "schema": {"type": "string"}} for name, text in SLICE_HEADERS.items()},
    }
}


@router.post(
    "/{scene}:slice",
    response_class=Response,
    openapi_extra=body_schema(SliceSettings, SLICE_EXAMPLES),
    responses=_ANSWER | problems(401, 404, 406, 413, 415, 422, 429, 500, 503, 504, 507),
)
async def render_slice(request: Request, service: ServiceDep, scene: SceneName) -> Response:
    """A field of the scene on any plane, without a probe. It waits and counts as a frame does."""
    media_type = choose_of_slice(request.headers.get("accept", ""))
    asked = await read_json_body(request, SliceSettings)
    deadline = service.planner.deadline(None)
    encoding = Encoding.PNG if media_type == PNG else asked.numbers
    plan = await service.planner.plan_slice(scene, asked, encoding)

    async def rendered() -> RenderResult[SliceView]:
        await service.limits.take_frames(1, deadline)
        return await service.render(plan, asked.pose()[None], deadline=deadline)

    result = await finish_or_abandon(rendered(), request.receive, deadline)
    data = _npy_of(result) if media_type == NPY else result.data
    return Response(data, 200, _headers(SliceFacts.of(result)), media_type)


def _npy_of(result: RenderResult[SliceView]) -> bytes:
    view = result.settings
    pixels = np.frombuffer(result.data, view.encoding.pixel_type).reshape(view.height, view.width)
    file = io.BytesIO()
    np.save(file, pixels)
    return file.getvalue()


def _headers(facts: SliceFacts) -> dict[str, str]:
    return {
        "X-Ultragray-Scene": facts.scene,
        "X-Ultragray-Scene-Sha256": facts.scene_sha256,
        "X-Ultragray-Shape": f"{facts.height},{facts.width}",
        "X-Ultragray-Dtype": facts.encoding.pixel_type.name,
        "X-Ultragray-Pixel-To-Scene": json.dumps(facts.pixel_to_scene.tolist()),
        "Server-Timing": ", ".join(f"{stage};dur={getattr(facts, f'{stage}_ms')}" for stage in STAGES),
    }
