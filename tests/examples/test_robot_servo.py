"""The robot finds the vessel and stays on it, judged by the labels of the scene, which it never sees."""

import asyncio
import subprocess
import sys
import time

import numpy as np
import pytest

from ultragray_client import Client, LinearProbe, RenderSettings
from ultragray_client.errors import Unavailable

from ..waiting import at_this_load
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
    with Client(demo_service.grpc, timeout_s=60.0) as client:
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


@pytest.mark.slow
def test_the_robot_converges_and_follows(servo, demo_service):
    record = asyncio.run(servo.servo(demo_service.grpc, seconds=6.0))
    assert 0.1 < record.found_after_s < at_this_load(2.0)
    assert len(record.errors_mm) > 60
    assert np.sqrt(np.mean(np.square(record.errors_mm))) < 1.0
    assert record.lost <= 0.05 * len(record.errors_mm)
    assert len(record.latencies_ms) + record.dropped + record.late == record.sent == 600
    with Client(demo_service.grpc, timeout_s=60.0) as client:
        checked = record.poses[:: len(record.poses) // 8]
        assert np.mean([abs(vessel_mm(client, pose)[0]) for pose in checked]) < 1.2
    assert f"in {len(record.errors_mm)} frames" in record.tell()


@pytest.mark.long
def test_as_a_program(demo_service):
    command = [sys.executable, EXAMPLES / "robot_servo.py", "--address", demo_service.grpc, "--seconds", "2.5"]
    told = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
    assert "latency p50" in told
    assert "off centre by" in told


@pytest.mark.long
@pytest.mark.parametrize("example", ["robot_servo", "augment_pytorch"])
def test_without_a_service_it_ends_at_once_with_one_line(example):
    command = [sys.executable, str(EXAMPLES / f"{example}.py"), "--address", "127.0.0.1:9"]
    started = time.monotonic()
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert time.monotonic() - started < at_this_load(10)  # most of it imports torch
    assert ended.returncode == 1
    assert ended.stderr.startswith("error: no service answers at 127.0.0.1:9")
    assert ended.stderr.count("\n") == 1
