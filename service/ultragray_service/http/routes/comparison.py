"""Pictures to compare: a scene beside the frames held out from it, and the frames and poses of a dataset."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path
from starlette.requests import Request
from starlette.responses import Response

from ultragray_service.http.deps import SceneName, ServiceDep, problems
from ultragray_service.http.reading.accept import PNG
from ultragray_service.http.revalidation import NOT_MODIFIED, revalidated
from ultragray_service.http.routes.datasets import DatasetName
from ultragray_service.views.prepared import Comparison, DatasetPoses

router = APIRouter(prefix="/v1", tags=["console"])

FrameIndex = Annotated[int, Path(ge=0, description="Place of the frame, from 0.")]
_Answers = dict[int | str, dict[str, Any]]
_PICTURE: _Answers = {
    200: {
        "description": "8-bit grey, square pixels, 512 on the longer side.",
        "content": {PNG: {"schema": {"type": "string", "format": "binary"}}},
    },
    304: {"description": NOT_MODIFIED},
}
_POSES: _Answers = {200: {"model": DatasetPoses}, 304: {"description": NOT_MODIFIED}}


@router.get("/scenes/{scene}/comparison", responses=problems(401, 404, 422, 503))
async def get_comparison(service: ServiceDep, scene: SceneName) -> Comparison:
    """Metrics on the held-out frames of the scene's dataset. The first request begins to compute them."""
    service.require_serving()
    return await service.comparisons.get(scene)


@router.get(
    "/scenes/{scene}/comparison/{index}/{what}.png",
    response_class=Response,
    responses=_PICTURE | problems(401, 404, 422),
)
async def get_compared_picture(
    request: Request,
    service: ServiceDep,
    scene: SceneName,
    index: FrameIndex,
    what: Literal["truth", "rendering", "median", "linear", "nearest", "difference"],
) -> Response:
    """A picture of a held-out frame; difference: three times the absolute one between truth and rendering."""
    key = await service.comparisons.key(scene)

    async def picture() -> Response:
        return Response(await service.comparisons.frame_png(key, index, what), media_type=PNG)

    return await revalidated(request, f"{key}-{what}-{index}", picture)


@router.get(
    "/datasets/{dataset}/poses",
    response_class=Response,
    responses=_POSES | problems(401, 404, 422, 500, 503, 504, 507),
)
async def get_dataset_poses(request: Request, service: ServiceDep, dataset: DatasetName) -> Response:
    """Probe to scene, of the training frames and the held-out ones."""
    service.require_serving()

    async def poses() -> Response:
        return Response(await service.dataset_views.poses_json(dataset), media_type="application/json")

    return await revalidated(request, f"{await service.dataset_views.key(dataset)}-poses", poses)


@router.get(
    "/datasets/{dataset}/frames/{part}/{index}",
    response_class=Response,
    responses=_PICTURE | problems(401, 404, 422, 500, 503, 504, 507),
)
async def get_dataset_frame(
    request: Request, service: ServiceDep, dataset: DatasetName, part: Literal["train", "val"], index: FrameIndex
) -> Response:
    """A frame of a dataset; those of convex and phased probes as fans."""
    service.require_serving()

    async def frame() -> Response:
        return Response(await service.dataset_views.frame_png(dataset, part, index), media_type=PNG)

    return await revalidated(request, f"{await service.dataset_views.key(dataset)}-{part}-{index}", frame)
