"""A training while it runs."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from starlette.responses import Response

from ultragray_service.http.deps import ServiceDep, problems
from ultragray_service.http.reading.accept import PNG
from ultragray_service.http.routes.jobs.jobs import JobId
from ultragray_service.views.prepared import TrainingCurve

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

_Answers = dict[int | str, dict[str, Any]]
_PREVIEW: _Answers = {
    200: {
        "description": "8-bit grey: the frame as it was recorded, and to its right as it is rendered.",
        "content": {PNG: {"schema": {"type": "string", "format": "binary"}}},
    }
}


@router.get("/{job}/curve", responses=problems(401, 404, 422, 503))
async def get_curve(service: ServiceDep, job: JobId) -> TrainingCurve:
    """Loss and held-out PSNR of a training so far, in at most 500 points."""
    return await service.training_views.curve(job)


@router.get(
    "/{job}/preview",
    response_class=Response,
    responses=_PREVIEW | problems(401, 404, 422, 500, 503, 504, 507),
)
async def get_preview(service: ServiceDep, job: JobId) -> Response:
    """A held-out frame, rendered from the last checkpoint of a running training: a new one comes every ten seconds."""
    service.require_serving()
    return Response(await service.training_views.preview_png(job), media_type=PNG)
