"""Frames for poses. The Accept header chooses the form; the workers encode: no pixel is touched here."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from fastapi import APIRouter
from starlette.requests import Request
from starlette.responses import Response

from ultragray.contract import to_dict
from ultragray.outputs import OUTPUTS, check_outputs
from ultragray.settings import Encoding
from ultragray_workers.pool.types import Priority, RenderRequest, RenderResult

from ...core.state import Service
from ..accept import JPEG, NPZ, PNG, RAW, choose
from ..deps import SCENE_NAME, problems
from ..disconnect import finish_or_abandon
from ..examples import RENDER_EXAMPLES
from ..json_body import read_json_body
from ..render_body import asked_settings, checked_poses, poses_as_written
from ..schemas import RenderBody
from ..stream_schemas import picture_json

router = APIRouter(prefix="/v1/scenes", tags=["render"])

_DTYPES = {Encoding.FLOAT32: "float32", Encoding.NPZ: "float32"}

RENDER_HEADERS = {
    "X-Ultragray-Scene": "Name of the scene.",
    "X-Ultragray-Scene-Sha256": "SHA-256 of the scene file.",
    "X-Ultragray-Renderer": "Name, version and backend of the renderer.",
    "X-Ultragray-Shape": "Outputs, poses, height, width: 1,1,512,512.",
    "X-Ultragray-Dtype": "uint8 or float32 (little endian).",
    "X-Ultragray-Outputs": "Outputs in the order of the data, with commas.",
    "X-Ultragray-Pose": "One pose only: the 4x4 matrix that was used, JSON. Of many, npz holds `poses`.",
    "X-Ultragray-Probe": "The probe that was used, JSON.",
    "X-Ultragray-Confidence": "Of each pose, with commas; empty where the scene cannot tell.",
    "X-Ultragray-Extrapolation": "One pose only: distance_mm, angle_deg, confidence, supported_share, JSON. "
    "Of many, npz holds them.",
    "X-Ultragray-Picture": "Where the pixels lie in the image plane, JSON: column_unit, first, step.",
    "X-Ultragray-Queue-Ms": "Waiting time.",
    "X-Ultragray-Render-Ms": "Render time of the batch that the poses were in.",
    "X-Ultragray-Encode-Ms": "Encoding time.",
    "X-Request-Id": "Id of the request: the one that was sent, or a new one.",
    "Server-Timing": "The three times, for browsers.",
}

_OPENAPI: dict[str, Any] = {
    "parameters": [{"name": "scene", "in": "path", "required": True, **SCENE_NAME}],
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": {"$ref": f"#/components/schemas/{RenderBody.__name__}"},
                "examples": RENDER_EXAMPLES,
            }
        },
    },
}
_BINARY = {"schema": {"type": "string", "format": "binary"}}
_ANSWER: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The frames. image/png and image/jpeg: one pose, one output. application/octet-stream "
        "(parameter dtype=uint8 or float32): the outputs one after another, each [C, H, W]. application/x-npz "
        "holds one float32 array [C, H, W] per output, `poses` [C, 4, 4], and the strings scene, scene_sha256 and "
        "renderer. `*/*` gives PNG where it can hold the request, else npz.",
        "content": {PNG: _BINARY, JPEG: _BINARY, RAW: _BINARY, NPZ: _BINARY},
        "headers": {name: {"description": text, "schema": {"type": "string"}} for name, text in RENDER_HEADERS.items()},
    }
}


@router.post(
    "/{scene}/render",
    response_class=Response,
    openapi_extra=_OPENAPI,
    responses=_ANSWER | problems(401, 404, 406, 413, 415, 422, 429, 500, 503, 504, 507),
)
async def render(request: Request) -> Response:
    """One frame per pose and output. Poses: probe to scene, in mm, in the frame of the training sweep."""
    # Taken from the request here, because FastAPI needs 0.07 ms to hand them over.
    service: Service = request.app.state.service
    scene: str = request.path_params["scene"]
    body = await read_json_body(request, RenderBody)
    planner = service.planner
    deadline = planner.deadline(None if body.timeout_ms is None else body.timeout_ms / 1000)
    written = poses_as_written(body, planner.max_poses_at_once)
    outputs = check_outputs(body.outputs)
    choice = choose(
        request.headers.get("accept", ""),
        frames=len(written),
        outputs=len(outputs),
        dtype=body.dtype,
        lossless=any(OUTPUTS[name].is_numbers for name in outputs),
    )
    settings = await planner.resolve(scene, asked_settings(body), choice.encoding)
    planner.check_pixels(settings, len(written))
    priority = Priority.INTERACTIVE if body.poses is None else Priority.BATCH
    asked = RenderRequest(scene, settings, await checked_poses(written), priority, deadline)
    result = await finish_or_abandon(service.render(asked), request.receive, deadline)
    return Response(result.data, 200, _headers(result), choice.media_type)


def _headers(result: RenderResult) -> dict[str, str]:
    queue, render_time, encode = (f"{ms:.3f}" for ms in (result.queue_ms, result.render_ms, result.encode_ms))
    headers = {
        "X-Ultragray-Scene": result.scene,
        "X-Ultragray-Scene-Sha256": result.scene_sha256,
        "X-Ultragray-Renderer": result.renderer,
        "X-Ultragray-Shape": f"{len(result.settings.outputs)},{len(result.poses)},{result.height},{result.width}",
        "X-Ultragray-Dtype": _DTYPES.get(result.settings.encoding, "uint8"),
        "X-Ultragray-Outputs": ",".join(result.settings.outputs),
        "X-Ultragray-Probe": json.dumps(to_dict(result.settings.probe)),
        "X-Ultragray-Confidence": ",".join(
            "" if told.confidence is None else f"{told.confidence:.3f}" for told in result.extrapolations
        ),
        "X-Ultragray-Picture": json.dumps(picture_json(result.settings.picture)),
        "X-Ultragray-Queue-Ms": queue,
        "X-Ultragray-Render-Ms": render_time,
        "X-Ultragray-Encode-Ms": encode,
        "Server-Timing": f"queue;dur={queue}, render;dur={render_time}, encode;dur={encode}",
    }
    if len(result.poses) == 1:
        headers["X-Ultragray-Extrapolation"] = json.dumps(asdict(result.extrapolations[0]))
        headers["X-Ultragray-Pose"] = json.dumps(result.poses[0].tolist())
    return headers
