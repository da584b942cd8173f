"""Data sets: uploaded, checked, listed, looked at, compared with scenes, deleted."""

from __future__ import annotations

import time
from functools import partial
from inspect import Parameter, Signature
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Path, Query
from starlette.requests import Request
from starlette.responses import Response

from ultragray.datasets.source import UPLOAD_OPTIONS, UPLOADED_FORMATS
from ultragray_service.core.datasets import DatasetPage
from ultragray_service.core.scenes import DEFAULT_PAGE_SIZE, MAX_PAGE_SIZE
from ultragray_service.core.threads import PATIENCE_S
from ultragray_service.core.uploads import DatasetUpload
from ultragray_service.errors import UnsupportedMediaType
from ultragray_service.http.accept import PNG
from ultragray_service.http.bodies import FileParts
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
    problems,
    revalidated,
)
from ultragray_service.views.prepared import Comparison, DatasetPoses
from ultragray_workers.datasets.store import DatasetRecord

router = APIRouter(prefix="/v1/datasets", tags=["datasets"])

MULTIPART = "multipart/form-data"
ARCHIVES = (
    "application/zip",
    "application/x-zip-compressed",
    "application/x-tar",
    "application/gzip",
    "application/x-gzip",
    "application/octet-stream",  # the archive's first bytes tell which it is
)

DatasetName = Annotated[str, Path(description="Name of the dataset.", examples=["liver"])]
PageSize = Annotated[int, Query(ge=1, le=MAX_PAGE_SIZE, description="Datasets on one page.")]


Private = Annotated[bool, Query(description="Whether others may not see it.")]


def _given_options(**options: str) -> dict[str, str]:
    return {name: value for name, value in options.items() if value}


_given_options.__signature__ = Signature(  # type: ignore[attr-defined]  # what FastAPI reads
    [
        Parameter(name, Parameter.KEYWORD_ONLY, default="", annotation=Annotated[str, Query(description=meaning)])
        for name, meaning in UPLOAD_OPTIONS.items()
    ]
)
GivenOptions = Annotated[dict[str, str], Depends(_given_options)]

_UPLOAD: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": f"An archive, or separate files: {' or '.join(one.upload_meaning for one in UPLOADED_FORMATS)}.",
        "content": {
            **dict.fromkeys(ARCHIVES, BINARY),
            MULTIPART: {
                "schema": {
                    "type": "object",
                    "properties": {"files": {"type": "array", "items": {"type": "string", "format": "binary"}}},
                }
            },
        },
    }
}
_PRESENT: Answers = {
    200: {"model": DatasetRecord, "description": "It is there already, with this content and these options."}
}
_PICTURE = answer("The image planes in space and some frames.", PNG)
_FRAME_PICTURE = answer("8-bit grey, square pixels, 512 on the longer side.", PNG) | NOT_MODIFIED
_POSES: Answers = {200: {"model": DatasetPoses}, **NOT_MODIFIED}


@router.put(
    "/{dataset}",
    status_code=201,
    openapi_extra=_UPLOAD,
    responses=_PRESENT | problems(401, 403, 409, 413, 415, 422, 429, 500, 501, 503, 504, 507),
)
async def put_dataset(
    request: Request,
    response: Response,
    service: ServiceDep,
    dataset: DatasetName,
    options: GivenOptions,
    private: Private = False,
) -> DatasetRecord:
    """Uploads a dataset, checks it as `ultragray check` does, and keeps it. Empty options: as it is stored."""
    service.life.require_serving()
    media_type = _media_type(request)
    check_upload(request, service.settings.max_dataset_bytes, "a dataset")
    async with service.uploads.receive(dataset, options, private=private) as upload:
        if media_type == MULTIPART:
            await _receive_files(request, upload)
        else:
            await _receive_archive(request, upload)
        deadline = time.monotonic() + PATIENCE_S
        record, is_new = await finish_or_abandon(upload.finish(), request.receive, deadline)
    response.status_code = 201 if is_new else 200
    return service.datasets.with_owner(record)


@router.post(
    "/{dataset}:simulate",
    status_code=201,
    responses=_PRESENT | problems(401, 403, 409, 413, 422, 429, 500, 501, 503, 504, 507),
)
async def simulate_dataset(
    request: Request, response: Response, service: ServiceDep, dataset: DatasetName, private: Private = False
) -> DatasetRecord:
    """Simulates a sweep over the built-in phantom, in about half a minute, and keeps it as a dataset."""
    service.life.require_serving()
    async with service.uploads.receive(dataset, {}, private=private) as upload:
        deadline = time.monotonic() + PATIENCE_S
        finishing = upload.finish(simulated=True)
        record, is_new = await finish_or_abandon(finishing, request.receive, deadline)
    response.status_code = 201 if is_new else 200
    return service.datasets.with_owner(record)


@router.get("", responses=problems(401, 422, 503))
async def list_datasets(
    service: ServiceDep, page_size: PageSize = DEFAULT_PAGE_SIZE, page_token: PageToken = ""
) -> DatasetPage:
    """The datasets by name."""
    return await service.datasets.page(page_size, page_token)


@router.get("/{dataset}", responses=problems(401, 404, 422, 503))
async def get_dataset(service: ServiceDep, dataset: DatasetName) -> DatasetRecord:
    """Size, probe, split, and what the check warned of."""
    return await service.datasets.get(dataset)


@router.get("/{dataset}/contact-sheet", response_class=Response, responses=_PICTURE | problems(401, 404, 422, 503))
async def get_contact_sheet(service: ServiceDep, dataset: DatasetName) -> Response:
    """A picture of the dataset, PNG."""
    return Response(await service.datasets.contact_sheet(dataset), media_type=PNG)


@router.delete("/{dataset}", status_code=204, responses=problems(401, 403, 404, 409, 422, 503))
async def delete_dataset(service: ServiceDep, dataset: DatasetName) -> None:
    """Deletes a dataset that no job needs, with the pictures and comparisons that were made of it."""
    await service.delete_dataset(dataset)


def _media_type(request: Request) -> str:
    content_type = request.headers.get("content-type", "application/octet-stream")  # curl -T sends none
    media_type = content_type.partition(";")[0].strip().lower()
    if media_type not in (MULTIPART, *ARCHIVES):
        raise UnsupportedMediaType(
            f"Content-Type must be {MULTIPART} or one of {', '.join(ARCHIVES)}, got {content_type[:200]!r}",
            field="Content-Type",
        )
    return media_type


async def _receive_archive(request: Request, upload: DatasetUpload) -> None:
    await upload.begin_archive()
    async for block in blocks_of(request, upload.next):
        await upload.write(block)


async def _receive_files(request: Request, upload: DatasetUpload) -> None:
    parts = FileParts(request.headers["content-type"])
    async for block in blocks_of(request, upload.next):
        for event in parts.feed(block):
            if isinstance(event, str):
                await upload.begin_file(event)
            else:
                await upload.write(event)
    parts.finish()


comparison_router = APIRouter(prefix="/v1", tags=["console"])

FrameIndex = Annotated[int, Path(ge=0, description="Place of the frame, from 0.")]


@comparison_router.get("/scenes/{scene}/comparison", responses=problems(401, 404, 422, 503))
async def get_comparison(service: ServiceDep, scene: SceneName) -> Comparison:
    """Metrics on the held-out frames of the scene's dataset. The first request begins to compute them."""
    service.life.require_serving()
    return await service.comparisons.get(scene)


@comparison_router.get(
    "/scenes/{scene}/comparison/{index}/{what}.png",
    response_class=Response,
    responses=_FRAME_PICTURE | problems(401, 404, 422),
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
    picture = partial(service.comparisons.frame_png, key, index, what)
    return await revalidated(request, f"{key}-{what}-{index}", picture, PNG)


@comparison_router.get(
    "/datasets/{dataset}/poses", response_class=Response, responses=_POSES | problems(401, 404, 422, 500, 503, 504, 507)
)
async def get_dataset_poses(request: Request, service: ServiceDep, dataset: DatasetName) -> Response:
    """Probe to scene, of the training frames and the held-out ones."""
    service.life.require_serving()
    views = service.dataset_views
    version = f"{await views.key(dataset)}-poses"
    return await revalidated(request, version, partial(views.poses_json, dataset), "application/json")


@comparison_router.get(
    "/datasets/{dataset}/frames/{part}/{index}",
    response_class=Response,
    responses=_FRAME_PICTURE | problems(401, 404, 422, 500, 503, 504, 507),
)
async def get_dataset_frame(
    request: Request, service: ServiceDep, dataset: DatasetName, part: Literal["train", "val"], index: FrameIndex
) -> Response:
    """A frame of a dataset; those of convex and phased probes as fans."""
    service.life.require_serving()
    views = service.dataset_views
    version = f"{await views.key(dataset)}-{part}-{index}"
    return await revalidated(request, version, partial(views.frame_png, dataset, part, index), PNG)
