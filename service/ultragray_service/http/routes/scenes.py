"""The scenes of the data folder."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query

from ultragray.confidence.assess import read_model
from ultragray.outputs import OUTPUTS
from ultragray.scene_info import SceneHeader

from ...core.catalog import DEFAULT_PAGE_SIZE, MAX_PAGE_SIZE, CatalogEntry, finite_metrics, summarise_training
from ..deps import SceneName, ServiceDep, problems
from ..schemas import (
    Bounds,
    ConfidenceOut,
    PoseOut,
    SceneEntry,
    SceneError,
    SceneLoaded,
    SceneOut,
    ScenePage,
    TrainingPosesOut,
    position_body,
    probe_body,
)

router = APIRouter(prefix="/v1/scenes", tags=["scenes"])

PageSize = Annotated[int, Query(ge=1, le=MAX_PAGE_SIZE, description="Scenes on one page.")]
PageToken = Annotated[str, Query(description="next_page_token of the page before.")]


@router.get("", response_model_exclude_none=True, responses=problems(401, 422))
async def list_scenes(
    service: ServiceDep, page_size: PageSize = DEFAULT_PAGE_SIZE, page_token: PageToken = ""
) -> ScenePage:
    """The scenes by name. New files appear without a restart; one that cannot be read has an `error`."""
    entries, next_page_token = await service.catalog.page(page_size, page_token)
    loaded, removable = service.pool.loaded(), await service.imports.removable()
    return ScenePage(
        scenes=[
            _entry(entry, loaded=loaded.get(entry.name, 0) > 0, removable=entry.name in removable) for entry in entries
        ],
        next_page_token=next_page_token,
    )


@router.get("/{scene}", responses=problems(401, 404, 422))
async def get_scene(service: ServiceDep, scene: SceneName) -> SceneOut:
    """Probe, bounds, centre, training poses and metrics; mm, in the frame of the training sweep."""
    header = await service.catalog.header(scene)
    return scene_out(scene, header, service.pool.loaded().get(scene, 0))


@router.post("/{scene}:load", responses=problems(401, 404, 422, 503, 507))
async def load_scene(service: ServiceDep, scene: SceneName) -> SceneLoaded:
    """Loads the scene into every worker ahead of its first frame (rendering also loads on demand)."""
    processes = await service.load(scene)
    return SceneLoaded(scene=scene, loaded=processes > 0, loaded_processes=processes)


@router.post("/{scene}:unload", responses=problems(401, 404, 422, 503))
async def unload_scene(service: ServiceDep, scene: SceneName) -> SceneLoaded:
    """Frees the scene's memory; no error where it is not loaded."""
    processes = await service.unload(scene)
    return SceneLoaded(scene=scene, loaded=processes > 0, loaded_processes=processes)


def _entry(entry: CatalogEntry, *, loaded: bool, removable: bool) -> SceneEntry:
    if entry.error is not None:
        error = SceneError(reason=entry.error.reason, detail=entry.error.detail)
        return SceneEntry(name=entry.name, loaded=loaded, removable=removable, error=error)
    assert entry.header is not None
    info = entry.header.info
    return SceneEntry(
        name=entry.name,
        loaded=loaded,
        removable=removable,
        gaussian_count=info.gaussian_count,
        image_height=info.image_height,
        image_width=info.image_width,
        file_bytes=entry.header.file_bytes,
    )


def scene_out(name: str, header: SceneHeader, loaded_processes: int) -> SceneOut:
    """The JSON of a scene."""
    info, told = header.info, read_model(header.info.confidence, len(header.training_poses))
    return SceneOut(
        name=name,
        loaded=loaded_processes > 0,
        loaded_processes=loaded_processes,
        file_bytes=header.file_bytes,
        gaussian_count=info.gaussian_count,
        sh_degree=info.sh_degree,
        intensity=info.intensity,
        centre_mm=position_body(info.centre_mm),
        bounds=Bounds(min_mm=position_body(info.bounds_min_mm), max_mm=position_body(info.bounds_max_mm)),
        probe=None if info.probe is None else probe_body(info.probe),
        image_height=info.image_height,
        image_width=info.image_width,
        training_poses=_training_poses(header),
        metrics=finite_metrics(header),
        dataset_name=None if info.dataset_name is None else str(info.dataset_name),
        dataset_sha256=None if info.dataset_sha256 is None else str(info.dataset_sha256),
        outputs=[name for name, output in OUTPUTS.items() if output.lacks(info) is None],
        label_names=info.label_names,
        confidence=None if told is None else ConfidenceOut(error=told.error, fitted_on=told.fitted_on),
    )


def _training_poses(header: SceneHeader) -> TrainingPosesOut:
    summary = summarise_training(header)
    if summary is None:
        return TrainingPosesOut(count=0)
    return TrainingPosesOut(
        count=summary.count,
        position_min_mm=position_body(summary.position_min_mm),
        position_max_mm=position_body(summary.position_max_mm),
        first=PoseOut.of(summary.first),
        middle=PoseOut.of(summary.middle),
        last=PoseOut.of(summary.last),
    )
