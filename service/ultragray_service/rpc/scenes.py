"""SceneService."""

from __future__ import annotations

import grpc

from ultragray.confidence.assess import read_model
from ultragray.scene_info import SceneHeader
from ultragray_proto.v1 import scenes_pb2

from ..core.catalog import DEFAULT_PAGE_SIZE, CatalogEntry, finite_metrics, summarise_training
from ..core.state import Service
from .messages import error_message, matrix_message, position_message, probe_message


class SceneService:
    """The methods of ultragray.v1.SceneService."""

    def __init__(self, service: Service) -> None:
        self._service = service

    async def ListScenes(  # noqa: N802
        self, request: scenes_pb2.ListScenesRequest, context: grpc.aio.ServicerContext
    ) -> scenes_pb2.ListScenesResponse:
        entries, next_page_token = await self._service.catalog.page(
            request.page_size or DEFAULT_PAGE_SIZE, request.page_token
        )
        loaded = self._service.pool.loaded()
        return scenes_pb2.ListScenesResponse(
            scenes=[_entry(entry, loaded=loaded.get(entry.name, 0) > 0) for entry in entries],
            next_page_token=next_page_token,
        )

    async def GetScene(  # noqa: N802
        self, request: scenes_pb2.GetSceneRequest, context: grpc.aio.ServicerContext
    ) -> scenes_pb2.Scene:
        header = await self._service.catalog.header(request.scene)
        return _scene(request.scene, header, self._service.pool.loaded().get(request.scene, 0))

    async def LoadScene(  # noqa: N802
        self, request: scenes_pb2.LoadSceneRequest, context: grpc.aio.ServicerContext
    ) -> scenes_pb2.LoadSceneResponse:
        processes = await self._service.load(request.scene)
        return scenes_pb2.LoadSceneResponse(scene=request.scene, loaded_processes=processes)

    async def UnloadScene(  # noqa: N802
        self, request: scenes_pb2.UnloadSceneRequest, context: grpc.aio.ServicerContext
    ) -> scenes_pb2.UnloadSceneResponse:
        processes = await self._service.unload(request.scene)
        return scenes_pb2.UnloadSceneResponse(scene=request.scene, loaded_processes=processes)


def _entry(entry: CatalogEntry, *, loaded: bool) -> scenes_pb2.SceneEntry:
    if entry.error is not None:
        return scenes_pb2.SceneEntry(name=entry.name, loaded=loaded, error=error_message(entry.error))
    assert entry.header is not None
    info = entry.header.info
    return scenes_pb2.SceneEntry(
        name=entry.name,
        loaded=loaded,
        gaussian_count=info.gaussian_count,
        image_height=info.image_height or 0,
        image_width=info.image_width or 0,
        file_bytes=entry.header.file_bytes,
    )


def _scene(name: str, header: SceneHeader, loaded_processes: int) -> scenes_pb2.Scene:
    info, told = header.info, read_model(header.info.confidence, len(header.training_poses))
    return scenes_pb2.Scene(
        name=name,
        loaded=loaded_processes > 0,
        loaded_processes=loaded_processes,
        file_bytes=header.file_bytes,
        gaussian_count=info.gaussian_count,
        sh_degree=info.sh_degree,
        intensity=info.intensity,
        centre_mm=position_message(info.centre_mm),
        bounds_min_mm=position_message(info.bounds_min_mm),
        bounds_max_mm=position_message(info.bounds_max_mm),
        probe=None if info.probe is None else probe_message(info.probe),
        image_height=info.image_height or 0,
        image_width=info.image_width or 0,
        training_poses=_training_poses(header),
        metrics=finite_metrics(header),
        dataset_name=str(info.dataset_name or ""),
        dataset_sha256=str(info.dataset_sha256 or ""),
        label_names=info.label_names,
        confidence=None if told is None else scenes_pb2.ConfidenceFit(error=told.error, fitted_on=told.fitted_on),
    )


def _training_poses(header: SceneHeader) -> scenes_pb2.TrainingPoses:
    summary = summarise_training(header)
    if summary is None:
        return scenes_pb2.TrainingPoses(count=0)
    return scenes_pb2.TrainingPoses(
        count=summary.count,
        position_min_mm=position_message(summary.position_min_mm),
        position_max_mm=position_message(summary.position_max_mm),
        first=matrix_message(summary.first),
        middle=matrix_message(summary.middle),
        last=matrix_message(summary.last),
    )
