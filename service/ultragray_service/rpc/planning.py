"""The settings of a call, checked."""

from __future__ import annotations

from ultragray.contract import under
from ultragray.errors import InvalidArgument
from ultragray.settings import Resolved
from ultragray_proto.v1 import rendering_pb2

from ..core.state import Service
from .messages import settings_from_message


async def resolved_settings(
    service: Service,
    message: rendering_pb2.RenderRequest | rendering_pb2.RenderBatchRequest | rendering_pb2.RenderStreamRequest,
) -> tuple[str, Resolved]:
    """The scene and the settings of a message, checked, with nothing left open.

    Raises what RequestPlanner.resolve raises; the field is a path below `settings`.
    """
    if not message.HasField("settings"):
        raise InvalidArgument("settings is required", field="settings")
    with under("settings"):
        settings = settings_from_message(message.settings)
        scene: str = message.settings.scene
        return scene, await service.planner.resolve(scene, settings, settings.encoding)
