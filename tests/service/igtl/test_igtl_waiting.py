"""Poses that wait, and subscriptions, without a service and without a clock."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from ultragray.geometry.registration import Registration, rows
from ultragray.rendering.settings import FrameSettings
from ultragray_service.igtl.commands import Setup
from ultragray_service.igtl.frames import MAX_WAITING_DEVICES, Feed, PoseMessage, Underway, WaitingPoses
from ultragray_service.igtl.messages import Message
from ultragray_workers.errors import QueueFull

SETUP = Setup(FrameSettings())


@dataclass
class FakeTurn:
    """Of a request that still waits in the pool."""

    poses: Any = None

    def give_to(self, poses: Any, deadline: float) -> bool:
        self.poses = poses
        return True


def waits_in_the_pool(underway: Underway) -> FakeTurn:
    underway.turn, underway.setup = (turn := FakeTurn()), SETUP  # type: ignore[assignment]
    return turn


def posed(device_name: str, x_mm: float = 0.0) -> PoseMessage:
    pose = np.eye(4)
    pose[0, 3] = x_mm
    return PoseMessage(Message("TRANSFORM", device_name), pose, 0.0)


async def taken(waiting: WaitingPoses) -> Underway:
    await waiting.come()
    return waiting.take()


def run(work: Callable[[WaitingPoses], Awaitable[None]]) -> None:
    async def main() -> None:
        await work(WaitingPoses())

    asyncio.run(main())


def test_each_device_has_its_turn_with_its_newest_pose() -> None:
    async def work(waiting: WaitingPoses) -> None:
        replaced = [
            waiting.put(posed(name, x_mm), 0.0, SETUP) for name, x_mm in (("a", 1), ("b", 2), ("a", 3), ("a", 4))
        ]
        assert replaced == [False, False, True, True]
        first, second = (await taken(waiting)).posed, (await taken(waiting)).posed
        assert (first.message.device_name, first.pose[0, 3], first.replaced) == ("a", 4, 2)
        assert (second.message.device_name, second.pose[0, 3], second.replaced) == ("b", 2, 0)

    run(work)


def test_a_newer_pose_takes_the_turn_of_one_that_waits_in_the_pool() -> None:
    async def work(waiting: WaitingPoses) -> None:
        waiting.put(posed("a", 1), 0.0, SETUP)
        underway = await taken(waiting)
        assert not waiting.put(posed("a", 2), 0.0, SETUP)  # it is being rendered
        turn = waits_in_the_pool(underway)
        assert waiting.put(posed("a", 3), 0.0, SETUP)  # of the two that wait here, the older one
        assert turn.poses is None
        underway = await taken(waiting)
        assert underway.posed.pose[0, 3] == 3
        turn = waits_in_the_pool(underway)
        assert not waiting.put(posed("b", 4), 0.0, SETUP)
        assert waiting.put(posed("a", 5), 0.0, SETUP)
        assert turn.poses[0, 0, 3] == 5
        assert (underway.posed.pose[0, 3], underway.posed.replaced) == (5, 2)

    run(work)


def test_a_pose_does_not_take_the_turn_of_one_with_another_setup() -> None:
    async def work(waiting: WaitingPoses) -> None:
        waiting.put(posed("a", 1), 0.0, SETUP)
        underway = await taken(waiting)
        turn = waits_in_the_pool(underway)
        waiting.again(posed("a", 1))  # a tool has moved
        waiting.again(posed("a", 1))
        assert waiting.put(posed("a", 2), 0.0, Setup(FrameSettings()))
        assert turn.poses is None
        underway = await taken(waiting)
        assert underway.posed.pose[0, 3] == 2
        turn = waits_in_the_pool(underway)
        assert not waiting.put(posed("a", 3), 0.0, Setup(FrameSettings()))
        assert turn.poses is None

    run(work)


def test_a_pose_that_takes_a_turn_is_led_as_the_one_before() -> None:
    async def work(waiting: WaitingPoses) -> None:
        waiting.put(posed("a", 1), 0.0, SETUP)
        underway = await taken(waiting)
        turn = waits_in_the_pool(underway)
        underway.registration = Registration(base_to_scene=rows(posed("a", 10).pose))
        assert underway.pose[0, 3] == 11
        assert waiting.put(posed("a", 5), 0.0, SETUP)
        assert turn.poses[0, 0, 3] == 15

    run(work)


def test_devices_without_end_are_refused() -> None:
    async def work(waiting: WaitingPoses) -> None:
        for number in range(MAX_WAITING_DEVICES):
            waiting.put(posed(str(number)), 0.0, SETUP)
        assert waiting.put(posed("0"), 0.0, SETUP)
        with pytest.raises(QueueFull, match="16 devices"):
            waiting.put(posed("one more"), 0.0, SETUP)

    run(work)


def test_settled_is_when_nothing_waits_and_nothing_is_under_way() -> None:
    async def work(waiting: WaitingPoses) -> None:
        await waiting.settled()
        waiting.put(posed("a"), 0.0, SETUP)
        await taken(waiting)
        settled = asyncio.ensure_future(waiting.settled())
        await asyncio.sleep(0)
        assert not settled.done()
        more = asyncio.ensure_future(taken(waiting))
        await asyncio.wait_for(settled, 5)
        more.cancel()

    run(work)


class _FrameOf:
    """A frame that goes by any name."""

    def goes_by(self, name: str) -> bool:
        return True

    def message(self, kind: str, version: int) -> Message:
        return Message(kind, "robot", version=version)


class _SkippingLoop(asyncio.SelectorEventLoop):
    """An event loop whose time goes on to the next thing that is due whenever there is nothing to do."""

    now = 1000.0

    def time(self) -> float:
        return self.now

    def _run_once(self) -> None:
        self.now += 1e-6  # no clock stands still while there is something to do
        if not self._ready and self._scheduled:  # type: ignore[attr-defined]
            self.now = max(self.now, self._scheduled[0].when())  # type: ignore[attr-defined]
        super()._run_once()  # type: ignore[misc]


def test_a_subscriber_is_told_at_most_as_often_as_it_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = _SkippingLoop()
    monkeypatch.setattr("ultragray_service.igtl.frames.time.monotonic", loop.time)
    told: list[float] = []

    async def send(message: Message) -> None:
        told.append(loop.time())

    async def work() -> None:
        feed = Feed(contextlib.nullcontext, send)
        feed.start("QTDATA", "", 0.3, 1)
        running = asyncio.ensure_future(feed.run())
        for _ in range(100):
            feed.offer(_FrameOf(), is_own=True)  # type: ignore[arg-type]
            await asyncio.sleep(0.01)
        feed.stop("QTDATA")
        await asyncio.sleep(1.0)
        running.cancel()

    loop.run_until_complete(work())
    loop.close()
    assert told == pytest.approx([1000.0, 1000.3, 1000.6, 1000.9], abs=0.02)
