"""A rendered frame, and the messages that carry it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from functools import lru_cache

import numpy as np

from ultragray.contract import to_dict
from ultragray.display.settings import Display, true_to_scale
from ultragray.registration.registration import Registration
from ultragray.settings import Encoding, Resolved
from ultragray.tools import Tool
from ultragray_service.igtl.commands.scanner import Scanner
from ultragray_service.igtl.contents import (
    Image,
    Instrument,
    pack_image,
    pack_instruments,
    pack_position,
    pack_transform,
)
from ultragray_service.igtl.messages import Message
from ultragray_service.igtl.routes import SceneChooser, image_name
from ultragray_service.igtl.waiting import PoseMessage, Underway
from ultragray_service.service import Service
from ultragray_workers.jobs.queue.owners import Kind, Ownership
from ultragray_workers.pool.types import RenderResult

_SLICE_MM = 1.0  # nominal thickness: an image of one slice has none


@dataclass(frozen=True, eq=False)
class Frame:
    """The rendering of a pose."""

    posed: PoseMessage
    result: RenderResult
    image: Image
    ownership: Ownership  # of its scene when it was rendered
    registration: Registration | None  # by which the client's poses lead into the scene; None: they are there

    def goes_by(self, name: str) -> bool:
        """Whether a query for `name` means this frame; a query without a name means any."""
        return name in ("", self.posed.message.device_name, image_name(self.posed.message.device_name))

    def message(self, kind: str, version: int, message_id: int = 0, name: str = "") -> Message:
        """The frame as an IMAGE, or its pose as a TRANSFORM, POSITION, TDATA or QTDATA; `name` in place of its own."""
        device_name, pose = self.posed.message.device_name, self.result.poses[0]
        if self.registration is not None:
            pose = self.registration.flange_to_base(pose)
        if kind == "IMAGE":
            content, own_name = pack_image(self.image), image_name(device_name)
        elif kind in ("TDATA", "QTDATA"):
            content, own_name = pack_instruments(kind, [Instrument(device_name, pose)]), device_name
        else:
            content, own_name = (pack_transform if kind == "TRANSFORM" else pack_position)(pose), device_name
        return Message(
            kind, name or own_name, content, self.posed.message.timestamp, version, message_id, self._metadata()
        )

    def _metadata(self) -> dict[str, str]:
        result = self.result
        return {
            "device": self.posed.message.device_name,
            "scene": result.scene,
            "scene_sha256": result.scene_sha256,
            "renderer": result.renderer,
            "slice_thickness_mm": repr(result.settings.beam.thickness_mm),
            "display": _text(result.settings.display),
            **self._placing(),
            "replaced_poses": str(self.posed.replaced),
            **{name: f"{value:.3f}" for name, value in asdict(result.extrapolations[0]).items() if value is not None},
            "queue_ms": f"{result.queue_ms:.3f}",
            "render_ms": f"{result.render_ms:.3f}",
        }

    def _placing(self) -> dict[str, str]:
        """What the frame can be rendered again with, beside its pose, where there is any."""
        settings, found = self.result.settings, {}
        if settings.registration is not None:
            found["registration"] = settings.registration
            found["probe_to_scene"] = json.dumps(self.result.poses[0].tolist(), separators=(",", ":"))
        if settings.tools:
            found["tools"] = f"[{','.join(map(_text, settings.tools))}]"
        return found


class FrameMaker:
    """Renders poses of devices."""

    def __init__(self, service: Service, scenes: SceneChooser, scanner: Scanner) -> None:
        self._service = service
        self._scenes = scenes
        self._scanner = scanner

    async def render(self, underway: Underway) -> Frame:
        """The frame of a pose, or of one that took its turn, as the scanner is set; else probe and size are those the
        scene was trained with, and its thickness is that of the service's setting, else that of the scene's beam.

        Raises SceneNotFound, RegistrationNotFound, and what RequestPlanner.plan and Service.render raise.
        """
        self._service.life.require_serving()
        scene = await self._scenes.choose(underway.posed.message.device_name)
        ownership = self._service.owners.known(Kind.SCENE, scene)
        setup, found = self._scanner.setup, None
        if setup.registration is not None:
            found = await self._service.registrations.of_scene(setup.registration, scene)
        underway.setup, underway.registration = setup, found
        asked = replace(setup.settings, tools=tools) if (tools := setup.tools.placed(found)) else setup.settings

        def complete(settings: Resolved) -> Resolved:
            return replace(self._true_to_scale(settings), registration=setup.registration)

        planner = self._service.planner
        plan = await planner.plan(scene, asked, Encoding.UINT8, complete=complete)
        result = await self._service.rendering.render(
            plan, underway.pose[None], deadline=planner.deadline(None), turn=underway.turn
        )
        return Frame(underway.posed, result, image_of(result, found), ownership, found)

    def _true_to_scale(self, settings: Resolved) -> Resolved:
        side = self._service.settings.max_image_side
        pixel_mm = true_to_scale(settings.probe, settings.height, side).pixel_mm
        return replace(settings, display=replace(settings.display, pixel_mm=pixel_mm))


@lru_cache(maxsize=256)
def _text(part: Display | Tool) -> str:
    """A part of the settings as JSON."""
    return json.dumps(to_dict(part, with_none=False), separators=(",", ":"))


def image_of(result: RenderResult, registration: Registration | None = None) -> Image:
    """The frame of a result of one pose, uint8 and B-mode with pixels in mm, as an image in the frame that the client's
    poses lead to: the base of the registration, else the scene.

    i runs along lateral x, j along depth z, k against elevation y, so that i, j, k is right-handed.
    """
    picture = result.settings.picture
    in_probe = np.zeros((4, 4))  # pixel→probe
    in_probe[0, 0], in_probe[2, 1] = picture.step
    in_probe[1, 2] = -_SLICE_MM
    in_probe[:, 3] = (picture.first[0], 0.0, picture.first[1], 1.0)
    pixels = np.frombuffer(result.data, np.uint8).reshape(picture.height, picture.width)
    to_scene = result.poses[0] @ in_probe
    return Image(pixels, to_scene if registration is None else registration.in_base(to_scene))
