"""The examples: a robot that servos, a data set of simulated frames, an agent that climbs; and each as a program."""

import asyncio
import subprocess
import sys
import time
from typing import NamedTuple

import gymnasium
import numpy as np
import pytest
import torch

from ultragray import GaussianScene, render
from ultragray.phantom.demo import DEMO_FILE
from ultragray_client import Client, LinearProbe, RenderSettings
from ultragray_client.errors import StreamEnded, Unavailable
from ultragray_studies.gym import STANDARD_PLANE

from ..waiting import SkippingLoop, at_this_load
from .conftest import EXAMPLES

VESSEL = 4
MM_PER_PIXEL = 60.0 / 128


@pytest.fixture(scope="module")
def servo(load_example):
    return load_example("robot_servo")


def vessel_mm(client, pose):
    """Where the vessel's middle is in truth: lateral from the centre of the image, and depth."""
    labels = client.render("demo", pose, RenderSettings(outputs=("labels",), height=128, width=128))["labels"]
    row, column = np.argwhere(labels == VESSEL).mean(axis=0)
    return (column + 0.5) * MM_PER_PIXEL - 30.0, (row + 0.5) * MM_PER_PIXEL


def test_the_vessel_is_found_where_it_is_and_nowhere_else(servo, demo_service):
    finder = servo.VesselFinder(LinearProbe(60.0, 0.0, 60.0))
    with Client(demo_service.grpc, timeout_s=300.0) as client:
        for y_mm in (-20.0, 0.0, 12.0):
            for x_mm, visible in ((-14.0, False), (0.0, True), (12.0, True), (25.0, True)):
                pose = np.eye(4)
                pose[:2, 3] = x_mm, y_mm
                image = client.render("demo", pose, RenderSettings(height=128, width=128))["bmode"]
                found = finder.find(image, None)
                assert (found is not None) == visible, (x_mm, y_mm)
                if visible:
                    np.testing.assert_allclose(found, vessel_mm(client, pose), atol=0.8)


class BlindStream:
    """Takes poses, and fails where a frame is asked for."""

    async def send(self, pose, *, timeout_s): ...

    async def done_sending(self): ...

    async def receive(self):
        raise Unavailable("gone")


def test_a_robot_that_sees_nothing_any_more_stops(servo):
    blind = servo.Servo(LinearProbe(60.0, 0.0, 60.0), rate_hz=100.0)
    with pytest.raises(Unavailable, match="gone"):
        asyncio.run(blind.run(BlindStream(), seconds=10.0))
    assert blind.record.sent < 10


class RenderedFrame(NamedTuple):
    """What the robot takes from a frame."""

    pose: np.ndarray  # [4, 4] mm
    image: np.ndarray  # [H, W]
    dropped: int
    latency_ms: float = 1.0

    def __getitem__(self, output):
        return self.image


class RenderedStream:
    """A latest stream without a service, whose frames of the demo scene take no time."""

    def __init__(self):
        self._scene, self._came, self._is_over = GaussianScene.load(DEMO_FILE), asyncio.Event(), False
        self._poses = []

    async def send(self, pose, *, timeout_s):
        self._poses.append(pose)
        self._came.set()

    async def done_sending(self):
        self._is_over = True
        self._came.set()

    async def receive(self):
        await self._came.wait()
        self._came.clear()
        if not self._poses:
            raise StreamEnded("over")
        *replaced, pose = self._poses
        self._poses.clear()
        image = render(self._scene, None, pose[None], height=128, width=128, outputs=("bmode",)).bmode[0]
        if self._is_over:
            self._came.set()
        return RenderedFrame(pose, (255 * image).round().to(torch.uint8).numpy(), len(replaced))


@pytest.mark.slow
def test_the_robot_converges_and_follows(servo, demo_service, monkeypatch):
    control, loop = servo.Servo(LinearProbe(60.0, 0.0, 60.0), rate_hz=100.0), SkippingLoop()
    with monkeypatch.context() as patched:
        patched.setattr(servo.time, "monotonic", loop.time)
        loop.run_until_complete(control.run(RenderedStream(), seconds=4.0))
    loop.close()
    record = control.record
    assert 0.1 < record.found_after_s < 2.0
    assert len(record.errors_mm) > 40
    assert np.sqrt(np.mean(np.square(record.errors_mm))) < 1.0
    assert record.lost <= 0.05 * len(record.errors_mm)
    assert len(record.latencies_ms) + record.dropped + record.late == record.sent == 400
    with Client(demo_service.grpc, timeout_s=300.0) as client:
        checked = record.poses[:: len(record.poses) // 8]
        assert np.mean([abs(vessel_mm(client, pose)[0]) for pose in checked]) < 1.2
    assert f"in {len(record.errors_mm)} frames" in record.tell()


def test_the_robot_at_a_service(servo, demo_service, monkeypatch):
    monkeypatch.setattr(servo, "FIRST_ANSWER_S", 60.0)
    monkeypatch.setattr(servo, "POSE_TIMEOUT_S", 60.0)  # what was dropped before a last frame that is late is not told
    record = asyncio.run(servo.servo(demo_service.grpc, seconds=0.3))
    assert len(record.latencies_ms) + record.dropped + record.late == record.sent == 30


@pytest.fixture(scope="module")
def augment(load_example):
    return load_example("augment_pytorch")


def test_an_epoch_is_the_same_whoever_loads_it(augment, demo_service):
    frames = augment.SimulatedFrames(demo_service.grpc, "demo", 5, labels=False, seed=3)
    first, again = list(frames), list(frames)
    assert len(first) == 5
    for one, other in zip(first, again, strict=True):
        assert one["bmode"].shape == (1, 256, 256)
        assert one["bmode"].dtype == torch.float32
        assert 0.1 < float(one["bmode"].max()) <= 1.0
        assert torch.equal(one["bmode"], other["bmode"])
    assert not torch.equal(first[0]["pose"], first[1]["pose"])
    frames.epoch = 1
    assert not torch.equal(next(iter(frames))["pose"], first[0]["pose"])


def test_labels_come_along_if_asked_for(augment, demo_service):
    sample = next(iter(augment.SimulatedFrames(demo_service.grpc, "demo", 1, labels=True, seed=0)))
    assert sample["labels"].shape == (256, 256)
    assert sample["labels"].dtype == torch.int64
    assert set(sample["labels"].unique().tolist()) <= {0, 1, 2, 3, 4}


@pytest.fixture(scope="module")
def plane(load_example):
    return load_example("standard_plane")


def test_the_agent_takes_back_what_did_not_help(plane):
    agent = plane.Climber(np.random.default_rng(0))
    agent.act(-1.0)
    agent.last = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert agent.act(-0.5)[0] == 1.0  # it helped: once more
    assert agent.act(-0.6)[0] == -1.0  # it did not: back
    assert agent.act(-0.5).any()  # something else
    assert agent.best == -0.5


@pytest.mark.slow
def test_it_comes_nearer_to_the_plane(plane):
    env = gymnasium.make(STANDARD_PLANE, scene=DEMO_FILE, height=64, width=64, start_mm=6.0, start_deg=6.0)
    episodes = [plane.scan(env, seed) for seed in (2, 3, 5)]
    first, last = (np.mean([getattr(one, when)["similarity"] for one in episodes]) for when in ("first", "last"))
    assert last > first + 0.2
    off = [[getattr(one, when)["distance_mm"] for one in episodes] for when in ("first", "last")]
    assert np.mean(off[1]) < np.mean(off[0])


@pytest.mark.long
@pytest.mark.parametrize(
    ("example", "options", "told"),
    [
        ("robot_servo", "--seconds 2.5", ["latency p50", "off centre by"]),
        ("augment_pytorch", "--frames 24 --batch-size 8 --workers 0", ["bmode [8, 1, 256, 256], pose", "24 frames"]),
        ("augment_pytorch", "--frames 24 --batch-size 8 --workers 2", ["bmode [8, 1, 256, 256], pose", "24 frames"]),
        ("standard_plane", "--episodes 1 --start-mm 2 --start-deg 2", ["similarity", "of 1 reached the plane"]),
        (
            "scan_policy",
            "--steps 2 --starts 2 --min-confidence 0.5",
            ["learned in", "of 2 starts reached", "confidence"],
        ),
    ],
)
def test_as_a_program(demo_service, example, options, told):
    address = [] if example in ("standard_plane", "scan_policy") else ["--address", demo_service.grpc]
    command = [sys.executable, EXAMPLES / f"{example}.py", *address, *options.split()]
    printed = subprocess.run(command, check=True, capture_output=True, text=True, timeout=300).stdout
    assert [words for words in told if words not in printed] == []


@pytest.mark.long
@pytest.mark.parametrize("example", ["robot_servo", "augment_pytorch"])
def test_without_a_service_it_ends_at_once_with_one_line(example):
    command = [sys.executable, str(EXAMPLES / f"{example}.py"), "--address", "127.0.0.1:9"]
    started = time.monotonic()
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert time.monotonic() - started < at_this_load(10)  # most of it imports torch
    assert ended.returncode == 1
    assert ended.stderr.startswith("error: no service answers at 127.0.0.1:9")
    assert ended.stderr.count("\n") == 1
