"""The settings of a call, checked."""

from __future__ import annotations

from ultragray.errors import InvalidArgument
from ultragray_proto.v1 import rendering_pb2
from ultragray_workers.pool.types import Priority, RenderRequest

from ..core.requests import field_under
from ..core.state import Service
from .messages import spec_from_message


async def plan_settings(
    service: Service,
    message: rendering_pb2.RenderRequest | rendering_pb2.RenderBatchRequest | rendering_pb2.RenderStreamRequest,
    priority: Priority,
) -> RenderRequest:
    """The checked settings of a message, still without poses.

    Raises what RequestPlanner.plan raises; the field is a path below `settings`.
    """
    if not message.HasField("settings"):
        raise InvalidArgument("settings is required", field="settings")
    with field_under("settings"):
        return await service.planner.plan(spec_from_message(message.settings), priority)
