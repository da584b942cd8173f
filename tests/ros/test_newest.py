"""Frames of the newest pose, from a real service; without ROS."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from ultragray_client import Client, Frame, RenderSettings
from ultragray_ros.newest import NewestFrames, Problems

from ..client.proxy import Proxy
from ..service.conftest import RunningService
from ..waiting import wait_until

SMALL = RenderSettings(height=16, width=16)


class Taker:
    """Keeps what comes, and holds the thread that brings it while it is told to."""

    def __init__(self) -> None:
        self.frames: list[tuple[Frame, int, int]] = []
        self.errors: list[Any] = []
        self.may_go_on = threading.Event()
        self.may_go_on.set()

    def take(self, frame: Frame, tag: int, replaced: int) -> None:
        self.frames.append((frame, tag, replaced))
        self.may_go_on.wait(60)

    def tags(self) -> list[int]:
        return [tag for _, tag, _ in self.frames]


@pytest.fixture
def client(ros_service: RunningService) -> Iterator[Client]:
    with Client(ros_service.grpc) as client:
        yield client


def newest(client: Client, taker: Taker, scene: str = "demo", timeout_s: float = 60.0) -> NewestFrames[int]:
    return NewestFrames(client, scene, SMALL, timeout_s=timeout_s, take=taker.take, tell=taker.errors.append)


def moved(x_mm: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x_mm
    return pose


def test_the_newest_pose_takes_the_place_of_those_that_wait(client: Client) -> None:
    taker = Taker()
    frames = newest(client, taker)
    taker.may_go_on.clear()
    frames.render(moved(0.0), 0)
    wait_until(lambda: taker.frames)
    for number in range(1, 6):
        frames.render(moved(number / 10), number)
    taker.may_go_on.set()
    wait_until(lambda: len(taker.frames) == 2)
    frames.close()
    assert taker.tags() == [0, 5]
    frame, _, replaced = taker.frames[1]
    assert replaced == 4
    assert frame.pose[0, 3] == 0.5


def test_a_pose_that_is_refused_leaves_the_stream_as_it_is(client: Client) -> None:
    taker = Taker()
    frames = newest(client, taker)
    frames.render(np.zeros((4, 4)), 1)
    wait_until(lambda: taker.errors)
    frames.render(np.eye(4), 2)
    wait_until(lambda: taker.frames)
    frames.close()
    assert [error.reason for error in taker.errors] == ["INVALID_POSE"]
    assert taker.tags() == [2]


def test_other_settings_and_another_scene_hold_from_the_next_pose_on(client: Client) -> None:
    taker = Taker()
    frames = newest(client, taker, scene="absent")
    frames.render(np.eye(4), 1)
    wait_until(lambda: taker.errors)
    frames.change("demo", RenderSettings(height=24, width=16))
    frames.render(np.eye(4), 2)
    wait_until(lambda: taker.frames)
    frames.close()
    assert [error.reason for error in taker.errors] == ["SCENE_NOT_FOUND"]
    assert taker.frames[0][0]["bmode"].shape == (24, 16)


def test_a_frame_that_is_too_late_is_told_and_not_taken(client: Client) -> None:
    taker = Taker()
    frames = newest(client, taker, timeout_s=1e-6)
    frames.render(np.eye(4), 1)
    wait_until(lambda: taker.errors)
    frames.close()
    assert [error.reason for error in taker.errors] == ["DEADLINE_EXCEEDED"]
    assert taker.frames == []


def test_a_service_that_comes_back_is_asked_again(ros_service: RunningService) -> None:
    proxy, taker = Proxy("127.0.0.1:1"), Taker()
    with Client(proxy.address) as client:
        frames = newest(client, taker)
        frames.render(np.eye(4), 1)
        wait_until(lambda: taker.errors)
        proxy.lead_to(ros_service.grpc)

        def came() -> bool:
            frames.render(np.eye(4), 2)
            return bool(taker.frames)

        wait_until(came, every_s=0.1)
        frames.close()
    proxy.close()
    assert {error.reason for error in taker.errors} == {"UNREACHABLE"}


def test_closing_ends_a_wait_for_a_frame(ros_service: RunningService) -> None:
    silent, taker = Proxy(ros_service.grpc), Taker()
    with Client(silent.address) as client:
        frames = newest(client, taker)
        silent.lead_to("127.0.0.1:1")
        frames.render(np.eye(4), 1)
        frames.close()
        frames.close()
    silent.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "ultragray-newest"]


def test_problems_are_told_once_in_a_while_by_their_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("ultragray_ros.newest.time.monotonic", lambda: now[0])
    told: list[str] = []
    problems = Problems(told.append)
    for _ in range(4):
        problems.tell("UNREACHABLE", "nobody answers")
    problems.tell("INVALID_POSE", "not a rotation")
    now[0] += 10.0
    problems.tell("UNREACHABLE", "nobody answers")
    assert told == [
        "UNREACHABLE: nobody answers",
        "INVALID_POSE: not a rotation",
        "UNREACHABLE: nobody answers (3 more like it since)",
    ]
