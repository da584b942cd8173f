"""Frames for poses. The Accept header chooses the form; the workers encode: no pixel is touched here."""

from __future__ import annotations

import json
from typing import Any

from fastapi import APIRouter
from starlette.requests import Request
from starlette.responses import Response

from ultragray.contract import to_dict
from ultragray.outputs import OUTPUTS
from ultragray_workers.pool.types import Priority, RenderRequest, RenderResult

from ...core.frames import FrameHeader
from ...core.poses import exact_poses
from ...core.state import Service
from ...telemetry.statistics import STAGES
from ..accept import JPEG, NPZ, PNG, RAW, choose
from ..bodies import RenderBody
from ..deps import SCENE_NAME, problems
from ..disconnect import finish_or_abandon
from ..examples import RENDER_EXAMPLES
from ..json_body import body_schema, read_json_body

router = APIRouter(prefix="/v1/scenes", tags=["render"])

_PREFIX = "X-Ultragray-"
_OF_ALL_FRAMES = (
    *("scene", "scene_sha256", "renderer", "outputs", "probe", "picture"),
    *(f"{stage}_ms" for stage in STAGES),
)
_OF_ONE_FRAME = ("pose", "extrapolation")

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
    **body_schema(RenderBody, RENDER_EXAMPLES),
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
    poses = body.poses_by_path(planner.max_poses_at_once)
    choice = choose(
        request.headers.get("accept", ""),
        frames=len(poses),
        outputs=len(body.outputs),
        dtype=body.dtype,
        lossless=any(OUTPUTS[name].is_numbers for name in body.outputs),
    )
    settings = await planner.resolve(scene, body, choice.encoding)
    planner.check_pixels(settings, len(poses))
    exact = await exact_poses(len(poses), lambda index: poses[index][1].exact(poses[index][0]))
    priority = Priority.INTERACTIVE if body.poses is None else Priority.BATCH
    asked = RenderRequest(scene, settings, exact, priority, deadline)
    result = await finish_or_abandon(service.render(asked), request.receive, deadline)
    return Response(result.data, 200, render_headers(result), choice.media_type)


def render_headers(result: RenderResult) -> dict[str, str]:
    """What the answer says beside the pixels: the fields of FrameHeader that hold for all frames, of one frame all."""
    header = FrameHeader.of(result)
    names = _OF_ALL_FRAMES if len(result.poses) > 1 else (*_OF_ALL_FRAMES, *_OF_ONE_FRAME)
    headers = {f"{_PREFIX}{name.title().replace('_', '-')}": _text(getattr(header, name)) for name in names}
    confidences = ("" if one.confidence is None else f"{one.confidence:.3f}" for one in result.extrapolations)
    return headers | {
        f"{_PREFIX}Shape": f"{len(header.outputs)},{len(result.poses)},{header.height},{header.width}",
        f"{_PREFIX}Dtype": header.encoding.pixel_type.name,
        f"{_PREFIX}Confidence": ",".join(confidences),
        "Server-Timing": ", ".join(f"{name};dur={getattr(header, f'{name}_ms'):.3f}" for name in STAGES),
    }


def _text(value: Any) -> str:
    if isinstance(value, (str, float)):
        return value if isinstance(value, str) else f"{value:.3f}"
    if isinstance(value, tuple):
        return ",".join(value)
    return json.dumps(value if isinstance(value, list) else to_dict(value))
