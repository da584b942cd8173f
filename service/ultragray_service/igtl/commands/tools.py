"""Tools in the frames of one connection: those that stay, and those that a device of the client moves."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from ultragray.contract import from_dict, shown, to_dict, under
from ultragray.errors import InvalidArgument
from ultragray.probe import FloatArray
from ultragray.registration.registration import Registration
from ultragray.tools import MAX_TOOLS, Tool
from ultragray_service.igtl.messages import DEVICE_NAME_BYTES

_DEVICE, _FRAME = "device", "frame"
_EXAMPLE = '[{"kind": "needle", "tip_mm": [0, 0, 0], "hub_mm": [0, 0, -120], "device": "NeedleToReference"}]'


@dataclass(frozen=True)
class ClientTool:
    """A tool as a client set it."""

    tool: Tool
    device: str | None  # that moves it, and whose frame its points are in; None: it stays


@dataclass(frozen=True, eq=False)
class ClientTools:
    """The tools of a client, and the poses that its devices sent last."""

    tools: tuple[ClientTool, ...] = ()
    poses: Mapping[str, FloatArray] = field(default_factory=dict)  # [4, 4] mm, exact, by device

    def are_moved_by(self, device: str) -> bool:
        """Whether a device moves any of them."""
        return any(one.device == device for one in self.tools)

    def moved(self, device: str, pose: FloatArray) -> ClientTools:  # [4, 4] mm, exact
        """The tools with a new pose of a device that moves some of them."""
        return replace(self, poses={**self.poses, device: pose})

    def placed(self, registration: Registration | None) -> tuple[Tool, ...]:
        """The tools of a frame: those of a device in the scene, and none whose device has sent no pose yet.

        `registration` leads from the frame that the poses of the devices lead to into the scene; None: it is the scene.
        """
        found = []
        for one in self.tools:
            if one.device is None:
                found.append(one.tool)
            elif (pose := self.poses.get(one.device)) is not None:
                to_scene = pose if registration is None else registration.marker_to_scene(pose)
                found.append(one.tool.moved(to_scene))
        return tuple(found)


def read_tools(text: str, before: ClientTools) -> ClientTools:
    """The tools of a JSON text; devices that moved tools of `before` are where they were.

    Raises InvalidArgument, naming the tool.
    """
    try:
        documents = json.loads(text)
    except (ValueError, RecursionError):
        documents = None
    if not isinstance(documents, list):
        raise InvalidArgument(f"must be a list in JSON such as {_EXAMPLE}, got {shown(text)}")
    if len(documents) > MAX_TOOLS:
        raise InvalidArgument(f"must be at most {MAX_TOOLS} tools, got {len(documents)}")
    tools = tuple(_read(number, one) for number, one in enumerate(documents))
    devices = {one.device for one in tools}
    return ClientTools(tools, {device: pose for device, pose in before.poses.items() if device in devices})


def tools_text(tools: ClientTools) -> str:
    """The tools as `read_tools` takes them."""
    return json.dumps([_document(one) for one in tools.tools])


def _read(number: int, document: Any) -> ClientTool:
    with under(f"[{number}]"):
        device = None
        if isinstance(document, dict) and document.get(_DEVICE) is not None:
            device = document[_DEVICE]
            if not isinstance(device, str) or not 1 <= len(device.encode()) <= DEVICE_NAME_BYTES:
                raise InvalidArgument(
                    f"device must be the name of one, of 1 to {DEVICE_NAME_BYTES} bytes, got {shown(device)}",
                    field=_DEVICE,
                )
            if _FRAME in document:
                raise InvalidArgument("frame stands in place of device: the points are in the device's", field=_FRAME)
            document = {name: value for name, value in document.items() if name != _DEVICE}
        return ClientTool(from_dict(Tool, document), device)


def _document(one: ClientTool) -> dict[str, Any]:
    document: dict[str, Any] = to_dict(one.tool)
    if one.device is None:
        return document
    return {**{name: value for name, value in document.items() if name != _FRAME}, _DEVICE: one.device}
