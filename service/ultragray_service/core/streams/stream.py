"""A stream of one client: its messages in their order, whatever they come through."""

from __future__ import annotations

from typing import Protocol

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray.probe import FloatArray
from ultragray.settings import RenderSettings
from ultragray_service.core.requests import Plan
from ultragray_service.core.state import Service
from ultragray_service.core.streams.answers import Answered
from ultragray_service.core.streams.open_streams import OpenStream
from ultragray_service.core.streams.pose_stream import Asked, PoseStream, StreamMode, unexpected
from ultragray_workers.pool.types import Destination

MAX_TIMEOUT_MS = 3_600_000.0

SceneSettings = tuple[str, RenderSettings]


class Message(Protocol):
    """A message of the client. What cannot be used is raised, as InvalidArgument, by the method that would give it."""

    @property
    def sequence(self) -> int: ...

    @property
    def client_time(self) -> float | None: ...

    @property
    def window(self) -> int | None:
        """Answers of a latest stream that may wait to be acknowledged; of the first message. None: none ever is."""

    @property
    def acknowledged(self) -> int | None:
        """The sequence of the newest answer that the client has taken; None: no news."""

    def settings(self) -> SceneSettings | None:
        """The scene and what to render of it from now on; None: as before."""

    @property
    def asks(self) -> bool:
        """Whether it asks for a frame."""

    def pose(self) -> FloatArray:  # [4, 4] mm, exact
        """The pose to render, of a message that asks."""

    def timeout_s(self) -> float | None:
        """The time that the pose may wait; None: the default of the service."""


class Transport(Protocol):
    """The connection that messages come through."""

    @property
    def destination(self) -> Destination | None:
        """Where frames are put, of a transport whose mode was asked for; None: into the answers."""

    async def receive(self) -> Message | None:
        """The next message; None after the last."""

    def mode(self, message: Message) -> StreamMode | None:
        """The mode that the first message asks for; None where it cannot be read: then the next one may."""

    async def send(self, answered: Answered) -> None:
        """Sends a frame, or why there is none."""

    async def hand_over(self, answered: Answered) -> None:
        """Sends, and waits until the client has taken the answer, as far as the transport can tell."""


class FrameStream:
    """Poses in, frames out. Refused settings change nothing: those before them stay, `unset` at the beginning.

    A client whose first settings are refused gets no frames with settings that it did not ask for.
    """

    def __init__(
        self,
        service: Service,
        transport: Transport,
        unset: SceneSettings | None = None,
        noted: OpenStream | None = None,
    ) -> None:
        self._service = service
        self._transport = transport
        self._unset = unset
        self._plan: Plan | None = None
        self._poses = PoseStream(service, noted)

    async def run(self) -> None:
        """Answers until the client has sent its last message and got its last frame.

        Raises Draining when the service stops, and what the transport raises.
        """
        await self._poses.run(self._read, self._transport.send, self._transport.hand_over)

    async def _read(self) -> None:
        mode = None
        while (message := await self._transport.receive()) is not None:
            if mode is None and (mode := self._transport.mode(message)) is not None:
                self._poses.mode, self._poses.destination = mode, self._transport.destination
                if message.window is not None:
                    self._poses.open_window(message.window)
            if message.acknowledged is not None:
                self._poses.acknowledge(message.acknowledged)
            await self._take(message)

    async def _take(self, message: Message) -> None:
        try:
            asked = await self._asked(message)
        except UltragrayError as error:
            await self._poses.refuse(message.sequence, message.client_time, error)
        except Exception as error:
            await self._poses.refuse(message.sequence, message.client_time, unexpected(error))
        else:
            if asked is not None:
                await self._poses.ask(asked)

    async def _asked(self, message: Message) -> Asked | None:
        await self._change_settings(message)
        if not message.asks:
            return None
        if self._plan is None:
            if self._unset is None:
                raise InvalidArgument("settings must be given, and accepted, before the first pose", field="settings")
            self._plan = await self._resolve(self._unset)
        pose, deadline = self._plan.placed(message.pose()), self._service.planner.deadline(message.timeout_s())
        return Asked(message.sequence, message.client_time, self._plan, pose, deadline)

    async def _change_settings(self, message: Message) -> None:
        unset, self._unset = self._unset, None  # as long as the message's own are not known to be none
        settings = message.settings()
        if settings is None:
            self._unset = unset
        else:
            self._plan = await self._resolve(settings)

    async def _resolve(self, settings: SceneSettings) -> Plan:
        scene, asked = settings
        return await self._service.planner.plan(
            scene, asked, asked.encoding, path="settings", registration=asked.registration
        )


def checked_s(name: str, milliseconds: float) -> float:
    """The seconds of a time that a client gave as the field `name`. Raises InvalidArgument."""
    if not 0.0 < milliseconds <= MAX_TIMEOUT_MS:
        raise InvalidArgument(
            f"{name} must be above 0 and at most {MAX_TIMEOUT_MS:g}, got {milliseconds:g}", field=name
        )
    return milliseconds / 1000.0
