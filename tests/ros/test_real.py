"""Real images and poses as a node gets them, into a recording of a real service; without ROS."""

import numpy as np
import pytest

from ultragray.geometry.pose import pose_from_position_quaternion
from ultragray_client import Client, LinearProbe, Placement, Quaternion
from ultragray_ros.real import RealFrames
from ultragray_workers.datasets.store import open_datasets

from ..waiting import wait_until

PROBE = LinearProbe(20.0, 0.0, 25.0)
MS = 1_000_000


def placed(x_mm, angle_deg=0.0):
    half = np.radians(angle_deg) / 2.0
    return Placement((x_mm, 0.0, 0.0), Quaternion(w=np.cos(half), x=0.0, y=0.0, z=np.sin(half)))


def pixels_of(number):
    return np.random.default_rng(number).integers(0, 255, (12, 16), dtype=np.uint8)


@pytest.fixture
def client(start_service, tmp_path):
    with Client(start_service(artifact_folder=tmp_path).grpc) as client:
        yield client


def recorded(folder):
    return [one for block in open_datasets(folder, folder).recordings.frames("liver") for one in block]


def test_an_image_is_recorded_at_the_pose_of_its_stamp(client, tmp_path):
    told = []
    frames = RealFrames(client, "liver", PROBE, tell=told.append)
    for number in range(4):
        frames.image((1000 + 100 * number + 25) * MS, pixels_of(number))
        frames.pose((1000 + 100 * number) * MS, placed(10.0 * number, 4.0 * number))
    frames.pose(1400 * MS, placed(40.0, 16.0))
    frames.close()
    found = recorded(tmp_path)
    assert [(one.number, one.time_s) for one in found] == [(n, pytest.approx(1.025 + 0.1 * n)) for n in range(4)]
    for number, one in enumerate(found):
        np.testing.assert_array_equal(one.pixels, pixels_of(number))
        expected = placed(10.0 * number + 2.5, 4.0 * number + 1.0)
        q = expected.quaternion
        pose = pose_from_position_quaternion(expected.position_mm, (q.w, q.x, q.y, q.z))
        np.testing.assert_allclose(one.pose, pose, atol=1e-4)
    assert told == []

    again = RealFrames(client, "liver", PROBE, tell=told.append)  # goes on where the first has ended
    again.image(9000 * MS, pixels_of(9))
    again.pose(9000 * MS, placed(5.0))
    again.close()
    assert [one.number for one in recorded(tmp_path)] == [0, 1, 2, 3, 4]


def test_images_without_poses_and_those_that_are_refused_are_told_and_the_others_go_on(client, tmp_path):
    told = []
    frames = RealFrames(client, "liver", PROBE, tell=told.append)
    frames.image(900 * MS, pixels_of(0))  # before all poses
    frames.pose(1000 * MS, placed(0.0))
    frames.image(1000 * MS, pixels_of(1))
    frames.image(1200 * MS, pixels_of(2))  # the tracker pauses
    frames.image(1500 * MS, np.zeros((12, 16), np.uint8))  # no echo
    frames.image(1500 * MS, pixels_of(4))
    frames.pose(1500 * MS, placed(1.0))
    wait_until(lambda: len(told) == 3)
    frames.close()
    assert [(one.number, one.pose[0, 3]) for one in recorded(tmp_path)] == [(0, 0.0), (3, 1.0)]
    assert sorted(error.reason for error in told) == ["INVALID_ARGUMENT", "INVALID_POSE", "INVALID_POSE"]
