"""SceneService."""

from __future__ import annotations

import grpc

from ultragray_proto.codec import to_message
from ultragray_proto.v1 import scenes_pb2
from ultragray_service.core.scenes import DEFAULT_PAGE_SIZE
from ultragray_service.service import Service


class SceneService:
    """The methods of ultragray.v1.SceneService."""

    def __init__(self, service: Service) -> None:
        self._service = service

    async def ListScenes(  # noqa: N802
        self, request: scenes_pb2.ListScenesRequest, context: grpc.aio.ServicerContext
    ) -> scenes_pb2.ListScenesResponse:
        page = await self._service.scenes.page(request.page_size or DEFAULT_PAGE_SIZE, request.page_token)
        return to_message(page, scenes_pb2.ListScenesResponse)

    async def GetScene(  # noqa: N802
        self, request: scenes_pb2.GetSceneRequest, context: grpc.aio.ServicerContext
    ) -> scenes_pb2.Scene:
        return to_message(await self._service.scenes.get(request.scene), scenes_pb2.Scene)

    async def LoadScene(  # noqa: N802
        self, request: scenes_pb2.LoadSceneRequest, context: grpc.aio.ServicerContext
    ) -> scenes_pb2.LoadSceneResponse:
        loaded = await self._service.scenes.load(request.scene)
        return to_message(loaded, scenes_pb2.LoadSceneResponse)

    async def UnloadScene(  # noqa: N802
        self, request: scenes_pb2.UnloadSceneRequest, context: grpc.aio.ServicerContext
    ) -> scenes_pb2.UnloadSceneResponse:
        loaded = await self._service.scenes.unload(request.scene)
        return to_message(loaded, scenes_pb2.UnloadSceneResponse)
