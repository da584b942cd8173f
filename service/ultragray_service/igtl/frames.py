"""Poses of a client's devices that wait, the frames that they become, and the messages that tell a frame."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import AbstractAsyncContextManager
from dataclasses import asdict, dataclass, replace
from functools import lru_cache

import numpy as np

from ultragray.geometry.motion import Prediction
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.registration import Registration
from ultragray.rendering.display import true_to_scale
from ultragray.rendering.settings import Encoding, Resolved, settings_used
from ultragray.scene.confidence import Extrapolation
from ultragray_service.core.rendering import PendingFrames
from ultragray_service.igtl.commands import Scanner, Setup
from ultragray_service.igtl.contents import (
    Image,
    Instrument,
    pack_image,
    pack_instruments,
    pack_position,
    pack_transform,
    pack_video,
)
from ultragray_service.igtl.messages import Message
from ultragray_service.igtl.routes import SceneChooser, image_name
from ultragray_service.igtl.video import VideoEncoder
from ultragray_service.service import Service
from ultragray_workers.errors import QueueFull
from ultragray_workers.jobs.owners import Kind, Ownership
from ultragray_workers.pool.messages import RenderResult

MAX_WAITING_DEVICES = 16


@dataclass(frozen=True, eq=False)
class PoseMessage:
    """A pose [4, 4] mm of a client's message, under the name of its device."""

    message: Message
    pose: FloatArray
    arrived: float  # time.perf_counter(), s
    replaced: int = 0  # poses of the device that were dropped for this one
    prediction: Prediction | None = None  # how the pose was foretold


@dataclass(eq=False)
class Underway:
    """A request to the render pool; while it waits there, a newer pose takes its turn, unless the setup has changed."""

    posed: PoseMessage
    pending: PendingFrames | None = None  # once it waits there
    setup: Setup | None = None  # that it is rendered with, once that is known
    registration: Registration | None = None  # likewise

    @property
    def pose(self) -> FloatArray:  # [4, 4] mm, exact
        return self._placed(self.posed.pose)

    def give_to(self, posed: PoseMessage, deadline: float, setup: Setup) -> bool:
        """Whether a newer pose, of a client with that setup now, has taken the turn."""
        if self.setup is not setup or self.pending is None:
            return False
        if not self.pending.give_to(self._placed(posed.pose)[None], deadline):
            return False
        self.posed = replace(posed, replaced=self.posed.replaced + 1)
        return True

    def _placed(self, pose: FloatArray) -> FloatArray:
        return pose if self.registration is None else self.registration.probe_to_scene(pose)


class WaitingPoses:
    """Takes poses as they come and gives them out one after another, each device in its turn."""

    def __init__(self) -> None:
        self._poses: dict[str, PoseMessage] = {}
        self._underway: Underway | None = None
        self._come = asyncio.Event()
        self._settled = asyncio.Event()
        self._settled.set()

    def put(self, posed: PoseMessage, deadline: float, setup: Setup) -> bool:
        """Takes a pose, to begin by `deadline` (time.monotonic(), s), of a client with that setup now; whether it
        replaced an older one.

        Raises QueueFull where too many devices wait.
        """
        name, underway = posed.message.device_name, self._underway
        older = self._poses.get(name)
        if older is None and underway is not None and underway.posed.message.device_name == name:
            if underway.give_to(posed, deadline, setup):
                return True
        elif older is None and len(self._poses) >= MAX_WAITING_DEVICES:
            raise QueueFull(f"at most {MAX_WAITING_DEVICES} devices of a client may wait for their frames")
        self._poses[name] = posed if older is None else replace(posed, replaced=older.replaced + 1)
        self._come.set()
        self._settled.clear()
        return older is not None

    def again(self, posed: PoseMessage) -> None:
        """Takes a pose again, to be rendered with another setup, unless one of its device still waits."""
        if posed.message.device_name not in self._poses:
            self._poses[posed.message.device_name] = posed
            self._come.set()
            self._settled.clear()

    async def come(self) -> None:
        """Waits for a pose. What was given out before has its answer by now."""
        self._underway = None
        if not self._poses:
            self._settled.set()
            self._come.clear()
            await self._come.wait()

    def take(self) -> Underway:
        self._underway = Underway(self._poses.pop(next(iter(self._poses))))
        return self._underway

    async def settled(self) -> None:
        await self._settled.wait()


_SLICE_MM = 1.0  # nominal thickness: an image of one slice has none


@dataclass(frozen=True, eq=False)
class Frame:
    posed: PoseMessage
    result: RenderResult
    image: Image
    ownership: Ownership  # of its scene when it was rendered
    registration: Registration | None  # by which the client's poses lead into the scene; None: they are there

    def goes_by(self, name: str) -> bool:
        """Whether a query for `name` means this frame; a query without a name means any."""
        return name in ("", self.posed.message.device_name, image_name(self.posed.message.device_name))

    def message(
        self, kind: str, version: int, message_id: int = 0, name: str = "", encoder: VideoEncoder | None = None
    ) -> Message:
        """The message that tells the frame; a VIDEO is the next one of its encoder, and takes milliseconds."""
        device_name, pose = self.posed.message.device_name, self.result.poses[0]
        if self.registration is not None:
            pose = self.registration.flange_to_base(pose)
        if kind == "IMAGE":
            content, own_name = pack_image(self.image), image_name(device_name)
        elif encoder is not None:
            content, own_name = pack_video(encoder.encode(self.image)), image_name(device_name)
        elif kind in ("TDATA", "QTDATA"):
            content, own_name = pack_instruments(kind, [Instrument(device_name, pose)]), device_name
        else:
            content, own_name = (pack_transform if kind == "TRANSFORM" else pack_position)(pose), device_name
        return Message(
            kind, name or own_name, content, self.posed.message.timestamp, version, message_id, self._metadata()
        )

    def _metadata(self) -> dict[str, str]:
        result, placing = self.result, {}
        if result.settings.registration is not None:
            placing["probe_to_scene"] = json.dumps(result.poses[0].tolist(), separators=(",", ":"))
        return {
            "device": self.posed.message.device_name,
            "scene": result.scene,
            "scene_sha256": result.scene_sha256,
            "renderer": result.renderer,
            **_settings_texts(result.settings),
            **placing,
            "replaced_poses": str(self.posed.replaced),
            **_texts(self.posed.prediction),
            **_texts(result.extrapolations[0]),
            "queue_ms": f"{result.queue_ms:.3f}",
            "render_ms": f"{result.render_ms:.3f}",
        }


def _texts(figures: Extrapolation | Prediction | None) -> dict[str, str]:
    known = {} if figures is None else asdict(figures)
    return {name: f"{value:.3f}" for name, value in known.items() if value is not None}


@lru_cache(maxsize=256)
def _settings_texts(settings: Resolved) -> Mapping[str, str]:
    """The part of the metadata that is the same for all frames of a device, until the scanner is set anew."""
    return settings_used(settings).texts()


async def render_frame(service: Service, scenes: SceneChooser, scanner: Scanner, underway: Underway) -> Frame:
    """The frame of a pose, or of one that took its turn, as the scanner is set.

    Probe and size are else those that the scene was trained with, and its thickness is that of the service's setting,
    else that of the scene's beam. Raises SceneNotFound, RegistrationNotFound, and what planner and rendering raise.
    """
    service.life.require_serving()
    scene = await scenes.choose(underway.posed.message.device_name)
    ownership = service.owners.known(Kind.SCENE, scene)
    setup, registration = scanner.setup, None
    if setup.registration is not None:
        registration = await service.registrations.of_scene(setup.registration, scene)
    underway.setup, underway.registration = setup, registration
    request = replace(setup.settings, tools=tools) if (tools := setup.tools.placed(registration)) else setup.settings

    def complete(settings: Resolved) -> Resolved:
        to_scale = true_to_scale(settings.probe, settings.height, service.settings.max_image_side)
        display = replace(settings.display, pixel_mm=to_scale.pixel_mm)
        return replace(settings, display=display, registration=setup.registration)

    plan = await service.planner.plan(scene, request, Encoding.UINT8, complete=complete)
    deadline = service.planner.deadline(None)
    with service.rendering.ask(plan, underway.pose[None], deadline=deadline) as underway.pending:
        result = await underway.pending.frames()
    return Frame(underway.posed, result, image_of(result, registration), ownership, registration)


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


EnterTurn = Callable[[], AbstractAsyncContextManager[None]]


@dataclass
class _Subscription:
    name: str
    interval_s: float
    version: int
    encoder: VideoEncoder | None
    due: float = 0.0  # time.monotonic(), s

    async def message(self, kind: str, frame: Frame) -> Message:
        if self.encoder is None:
            return frame.message(kind, self.version)
        return await asyncio.to_thread(frame.message, kind, self.version, encoder=self.encoder)


class Feed:
    """The subscriptions of one client, by kind of message. Holds one frame for each at most."""

    def __init__(self, turn: EnterTurn, send: Callable[[Message], Awaitable[None]]) -> None:
        """`turn` is entered for each message, and waits until the client has read what came before."""
        self._turn, self._send = turn, send
        self._subscriptions: dict[str, _Subscription] = {}
        self._fresh: dict[str, Frame] = {}
        self._changed = asyncio.Event()

    def start(self, kind: str, name: str, interval_s: float, version: int, encoder: VideoEncoder | None = None) -> None:
        self._subscriptions[kind] = _Subscription(name, interval_s, version, encoder)
        self._changed.set()

    def films(self, frame: Frame) -> bool:
        """Whether the client gets this frame as VIDEO."""
        subscription = self._subscriptions.get("VIDEO")
        return subscription is not None and frame.goes_by(subscription.name)

    def stop(self, kind: str) -> None:
        self._subscriptions.pop(kind, None)
        self._fresh.pop(kind, None)

    def offer(self, frame: Frame, *, is_own: bool) -> None:
        """A frame was rendered; its sender gets the image anyway."""
        for kind, subscription in self._subscriptions.items():
            if frame.goes_by(subscription.name) and not (is_own and kind == "IMAGE"):
                self._fresh[kind] = frame
                self._changed.set()

    async def run(self) -> None:
        while True:
            due = min((self._subscriptions[kind].due for kind in self._fresh), default=None)
            timeout_s = None if due is None else due - time.monotonic()
            if timeout_s is None or timeout_s > 0:
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(self._changed.wait(), timeout_s)
            self._changed.clear()
            now = time.monotonic()
            for kind in [kind for kind in self._fresh if self._subscriptions[kind].due <= now]:
                async with self._turn():
                    if (frame := self._fresh.pop(kind, None)) is not None:  # may have been stopped meanwhile
                        subscription = self._subscriptions[kind]
                        subscription.due = time.monotonic() + subscription.interval_s
                        message = await subscription.message(kind, frame)
                        if self._subscriptions.get(kind) is subscription:
                            await self._send(message)
