"""Parameters of the node, and frames of the newest pose from a real service; without ROS."""

import math
import threading
from array import array
from dataclasses import fields

import numpy as np
import pytest

from ultragray_client import Below, Breathing, Client, Contact, ConvexProbe, Display, Needle, RenderSettings, ToolFrame
from ultragray_client.errors import InvalidArgument
from ultragray_ros.newest import NewestFrames, Problems
from ultragray_ros.parameters import defaults, settings_of

from ..client.proxy import Proxy
from ..waiting import wait_until


def test_every_setting_is_a_parameter():
    settings = {item.name for item in fields(RenderSettings)} - {"encoding", "display"}
    assert set(defaults()) == settings | {f"display.{item.name}" for item in fields(Display)}


def test_the_defaults_leave_everything_to_the_scene():
    assert settings_of(defaults()) == RenderSettings()


def test_no_default_is_of_a_type_that_ros_lacks():
    for name, value in defaults().items():
        assert isinstance(value, (bool, int, float, str, list)), name
        assert value != [], f"{name}: the type of an empty list is not known"


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"height": 128, "outputs": ["bmode", "echo"]}, RenderSettings(height=128, outputs=("bmode", "echo"))),
        (
            {"min_confidence": 0.5, "below_min_confidence": "mask"},
            RenderSettings(min_confidence=0.5, below_min_confidence=Below.MASK),
        ),
        ({"contact": "air"}, RenderSettings(contact=Contact.AIR)),
        (
            {"display.gain_db": -1.0, "display.tgc_db": [0.0, 6.0]},
            RenderSettings(display=Display(gain_db=-1.0, tgc_db=(0.0, 6.0))),
        ),
        ({"phase": array("d", [0.0])}, RenderSettings(phase=(0.0,))),  # rclpy gives arrays
        ({"phase": array("d", [math.nan])}, RenderSettings()),
        ({"breathing": '{"period_s": 3}'}, RenderSettings(breathing=Breathing(period_s=3.0))),
        ({"contact": "pressure", "indentation_mm": 5.0}, RenderSettings(contact=Contact.PRESSURE, indentation_mm=5.0)),
        (
            {"probe": '{"kind": "convex", "opening_angle_deg": 60, "near_mm": 40, "far_mm": 95}'},
            RenderSettings(probe=ConvexProbe(60, 40, 95)),
        ),
        ({"probe": "C5-2"}, RenderSettings(probe=ConvexProbe(70, 50, 200))),
        (
            {
                "tools": '[{"kind": "needle", "tip_mm": [5, 0, 30], "hub_mm": [-9, 0, 4], "frame": "probe"}]',
                "ghost": 0.5,
            },
            RenderSettings(tools=(Needle(tip_mm=(5, 0, 30), hub_mm=(-9, 0, 4), frame=ToolFrame.PROBE),), ghost=0.5),
        ),
        ({"tools": "[]", "registration": "robot"}, RenderSettings(tools=(), registration="robot")),
    ],
)
def test_what_parameters_stand_for(given, expected):
    assert settings_of({**defaults(), "scene": "demo", **given}) == expected


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"contact": "firm"}, "contact must be one of air, pressure, got 'firm'"),
        ({"probe": "convex"}, "probe must be JSON with a kind"),
        ({"probe": '{"kind": "square"}'}, "one of convex, linear, phased, radial, steered, and its numbers"),
        ({"probe": '{"kind": "phased", "opening_angle_deg": "wide", "far_mm": 9}'}, "could not convert"),
        ({"breathing": "deep"}, "breathing must be JSON with period_s, depth, got 'deep'"),
        ({"breathing": '{"depth_mm": 2}'}, "unexpected keyword argument 'depth_mm'"),
        ({"tools": "needle"}, "tools must be JSON with a kind, one of box, cylinder, needle"),
        ({"tools": '{"kind": "needle"}'}, "it is no list"),
        (
            {"tools": '[{"kind": "needle", "tip_mm": [0, 0, 1], "hub_mm": [0, 0, 2], "frame": "base"}]'},
            "tools: frame must be one of scene, probe, got 'base'",
        ),
    ],
)
def test_a_word_that_does_not_exist_is_refused(given, told):
    with pytest.raises(InvalidArgument, match=told):
        settings_of({**defaults(), **given})


SMALL = RenderSettings(height=16, width=16)


class Taker:
    """Keeps what comes, and holds the thread that brings it while it is told to."""

    def __init__(self):
        self.frames = []
        self.errors = []
        self.may_go_on = threading.Event()
        self.may_go_on.set()

    def take(self, frame, tag, replaced):
        self.frames.append((frame, tag, replaced))
        self.may_go_on.wait(300)

    def tags(self):
        return [tag for _, tag, _ in self.frames]


@pytest.fixture
def client(ros_service):
    with Client(ros_service.grpc) as client:
        yield client


def newest(client, taker, scene="demo", timeout_s=300.0, **more):
    return NewestFrames(client, scene, SMALL, timeout_s=timeout_s, take=taker.take, tell=taker.errors.append, **more)


def moved(x_mm):
    pose = np.eye(4)
    pose[0, 3] = x_mm
    return pose


def test_frames_are_those_of_when_they_are_seen_by_the_stamps_of_poses(client):
    taker = Taker()
    frames = newest(client, taker, seen_after_ms=100.0)
    frames.render(moved(0.0), 0, age_s=0.2)
    wait_until(lambda: taker.frames)
    frame = taker.frames[0][0]
    frames.close()
    assert frame.latency_ms > 200.0
    assert frame.prediction.ahead_ms == 100.0, "of a first pose: no latency is known yet, and nothing is foretold"


def test_the_newest_pose_takes_the_place_of_those_that_wait(client):
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


def test_a_pose_that_is_refused_leaves_the_stream_as_it_is(client):
    taker = Taker()
    frames = newest(client, taker)
    frames.render(np.zeros((4, 4)), 1)
    wait_until(lambda: taker.errors)
    frames.render(np.eye(4), 2)
    wait_until(lambda: taker.frames)
    frames.close()
    assert [error.reason for error in taker.errors] == ["INVALID_POSE"]
    assert taker.tags() == [2]


def test_other_settings_and_another_scene_hold_from_the_next_pose_on(client):
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


def test_a_frame_that_is_too_late_is_told_and_not_taken(client):
    taker = Taker()
    frames = newest(client, taker, timeout_s=1e-6)
    frames.render(np.eye(4), 1)
    wait_until(lambda: taker.errors)
    frames.close()
    assert [error.reason for error in taker.errors] == ["DEADLINE_EXCEEDED"]
    assert taker.frames == []


def test_a_service_that_comes_back_is_asked_again(ros_service):
    proxy, taker = Proxy("127.0.0.1:1"), Taker()
    with Client(proxy.address) as client:
        frames = newest(client, taker)
        frames.render(np.eye(4), 1)
        wait_until(lambda: taker.errors)
        proxy.lead_to(ros_service.grpc)

        def came():
            frames.render(np.eye(4), 2)
            return bool(taker.frames)

        wait_until(came, every_s=0.1)
        frames.close()
    proxy.close()
    assert {error.reason for error in taker.errors} == {"UNREACHABLE"}


def test_closing_ends_a_wait_for_a_frame(ros_service):
    silent, taker = Proxy(ros_service.grpc), Taker()
    with Client(silent.address) as client:
        frames = newest(client, taker)
        silent.lead_to("127.0.0.1:1")
        frames.render(np.eye(4), 1)
        frames.close()
        frames.close()
    silent.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "ultragray-newest"]


def test_problems_are_told_once_in_a_while_by_their_kind(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("ultragray_ros.newest.time.monotonic", lambda: now[0])
    told = []
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
