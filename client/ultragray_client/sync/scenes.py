# Generated from aio/scenes.py by client/generate.py; change that file.
"""The scenes of a service."""

from __future__ import annotations

from ultragray_client.records import Scene, SceneEntry, entry_from_message, scene_from_message
from ultragray_proto.v1 import scenes_pb2, scenes_pb2_grpc

from .connection import Connection


class Scenes:
    """`client.scenes`. All raise ClientError; a name that does not exist is SceneNotFound."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._calls = scenes_pb2_grpc.SceneServiceStub(connection.channel)

    def list(self, *, timeout_s: float | None = None) -> tuple[SceneEntry, ...]:
        """All scenes by name."""
        request = scenes_pb2.ListScenesRequest()
        scenes = self._connection.listed(self._calls.ListScenes, request, "scenes", timeout_s)
        return tuple(map(entry_from_message, scenes))

    def get(self, name: str, *, timeout_s: float | None = None) -> Scene:
        """All that a scene says about itself."""
        request = scenes_pb2.GetSceneRequest(scene=name)
        return scene_from_message(self._connection.answer(self._calls.GetScene, request, timeout_s))

    def load(self, name: str, *, timeout_s: float | None = None) -> int:
        """Loads a scene ahead of its first frame; the number of render processes that hold it."""
        request = scenes_pb2.LoadSceneRequest(scene=name)
        return int((self._connection.answer(self._calls.LoadScene, request, timeout_s)).loaded_processes)

    def unload(self, name: str, *, timeout_s: float | None = None) -> int:
        """Frees a scene's memory; the number of render processes that still hold it."""
        request = scenes_pb2.UnloadSceneRequest(scene=name)
        return int((self._connection.answer(self._calls.UnloadScene, request, timeout_s)).loaded_processes)
