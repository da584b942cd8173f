"""The newest pose of each device of a client."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, replace

from ultragray.probe import FloatArray
from ultragray.registration.registration import Registration
from ultragray_service.igtl.commands.scanner import Setup
from ultragray_service.igtl.messages import Message
from ultragray_workers.errors import QueueFull
from ultragray_workers.pool.waiting import Turn

MAX_WAITING_DEVICES = 16


@dataclass(frozen=True, eq=False)
class PoseMessage:
    """A pose [4, 4] mm of a client's message, under the name of its device."""

    message: Message
    pose: FloatArray
    arrived: float  # time.perf_counter(), s
    replaced: int = 0  # poses of the device that were dropped for this one


@dataclass(eq=False)
class Underway:
    """A request to the render pool; while it waits there, a newer pose takes its turn, unless the setup has changed."""

    posed: PoseMessage
    turn: Turn
    setup: Setup | None = None  # that it is rendered with, once that is known
    registration: Registration | None = None  # likewise

    @property
    def pose(self) -> FloatArray:  # [4, 4] mm, exact
        """The pose of the probe in the scene."""
        return self._placed(self.posed.pose)

    def give_to(self, posed: PoseMessage, deadline: float, setup: Setup) -> bool:
        """Whether a newer pose, of a client with that setup now, has taken the turn."""
        if self.setup is not setup or not self.turn.give_to(self._placed(posed.pose)[None], deadline):
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
        """Takes a pose that was there before and is to be rendered with another setup.

        One of its device that still waits will be.
        """
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
        """Takes a pose out, of which there is one."""
        self._underway = Underway(self._poses.pop(next(iter(self._poses))), Turn())
        return self._underway

    async def settled(self) -> None:
        """Waits until every pose so far was answered or replaced."""
        await self._settled.wait()
