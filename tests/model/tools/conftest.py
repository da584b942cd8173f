"""Frames with nothing in them but tools, and tools that lie where an image says."""

import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe, PhasedProbe, RadialProbe, SteeredProbe

LINEAR = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
PROBES = (
    LINEAR,
    SteeredProbe(width_mm=40.0, steering_deg=20.0, near_mm=0.0, far_mm=50.0),
    ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=80.0),
    PhasedProbe(opening_angle_deg=80.0, far_mm=60.0),
    RadialProbe(near_mm=5.0, far_mm=45.0),
)


@pytest.fixture(scope="session")
def empty_scene(random_scene):
    """A scene without anything in sight: echo 0, transmittance 1."""
    return random_scene(1, centre_cm=(0.0, 0.0, -500.0))


@pytest.fixture(scope="session")
def point_at():
    def find(probe, pose, row, column):  # [3] mm in the scene frame
        """The point of the image plane at a row and a column, from 0 to 1."""
        return pose[:3, :3] @ probe.points_mm(np.array(row), np.array(column)) + pose[:3, 3]

    return find
