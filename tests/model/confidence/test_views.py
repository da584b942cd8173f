"""Distances, angles and neighbourhoods of poses to training views, against geometry done by hand or by brute force."""

from __future__ import annotations

import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe, PhasedProbe, Probe, RadialProbe, SteeredProbe
from ultragray.errors import InvalidPose
from ultragray.geometry.probe import FloatArray
from ultragray.scene.confidence import MAX_VIEWS, POINTS_PER_SIDE, TrainingViews, ViewMeasures

LINEAR = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=40.0, far_mm=120.0)
PHASED = PhasedProbe(opening_angle_deg=80.0, far_mm=100.0)
RADIAL = RadialProbe(near_mm=2.0, far_mm=30.0)
STEERED = SteeredProbe(width_mm=40.0, steering_deg=-25.0, near_mm=5.0, far_mm=50.0)


def parallel(*elevations_mm: float) -> FloatArray:
    poses = np.tile(np.eye(4), (len(elevations_mm), 1, 1))
    poses[:, 1, 3] = elevations_mm
    return poses


def tilted(angle_deg: float) -> FloatArray:
    """About x, the probe's lateral axis."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    pose = np.eye(4)
    pose[1:3, 1:3] = [[c, -s], [s, c]]
    return pose[None]


def in_plane(angle_deg: float) -> FloatArray:
    """About y, so that the image plane stays."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    pose = np.eye(4)
    pose[0, 0], pose[0, 2], pose[2, 0], pose[2, 2] = c, s, -s, c
    return pose[None]


@pytest.mark.parametrize("probe", [LINEAR, CONVEX, PHASED, RADIAL, STEERED])
def test_a_training_view_is_no_distance_away(probe: Probe) -> None:
    measured = TrainingViews(parallel(0.0, 3.0), probe).measure(parallel(3.0), probe)
    for values in (measured.nearest_mm, measured.distance_mm, measured.interpolation_mm, measured.angle_deg):
        assert values.shape == (1, POINTS_PER_SIDE**2)
        assert values == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize(
    ("at_mm", "distance_mm", "interpolation_mm"),
    [(2.0, 2.0, 1.0), (1.0, 1.0, 0.75), (7.0, 3.0, 3.0), (-5.0, 5.0, 5.0), (104.0, 20.0, 20.0)],
)
def test_between_two_views_counts_half_and_beyond_them_all(
    at_mm: float, distance_mm: float, interpolation_mm: float
) -> None:
    measured = averaged(TrainingViews(parallel(0.0, 4.0), LINEAR).measure(parallel(at_mm), LINEAR))
    assert measured.distance_mm[0] == pytest.approx([distance_mm])
    assert measured.interpolation_mm[0] == pytest.approx([interpolation_mm], rel=1e-3)
    assert measured.nearest_mm[0] == pytest.approx([min(abs(at_mm), abs(at_mm - 4.0))])


def averaged(measures: ViewMeasures) -> ViewMeasures:
    """The same with the mean over the points as the only one."""
    names = ("nearest_mm", "distance_mm", "interpolation_mm", "angle_deg")
    means = {name: getattr(measures, name).mean(axis=1, keepdims=True) for name in names}
    return ViewMeasures(**means, weights=measures.weights)


def test_a_view_of_a_probe_that_was_turned_round_is_on_the_same_side() -> None:
    views = parallel(0.0, 4.0)
    views[1, :3, :3] = np.diag([-1.0, -1.0, 1.0])
    measured = averaged(TrainingViews(views, LINEAR).measure(parallel(2.0), LINEAR))
    assert measured.interpolation_mm[0] == pytest.approx([1.0])


@pytest.mark.parametrize("probe", [LINEAR, CONVEX, PHASED, RADIAL, STEERED])
def test_distance_to_an_image_and_not_to_its_plane(probe: Probe) -> None:
    pose = tilted(12.0)
    pose[0, :3, 3] = (15.0, 4.0, 9.0)
    measured = averaged(TrainingViews(np.eye(4)[None], probe).measure(pose, probe))
    lines, rows = 400, 400
    origins, directions = probe.scan_lines(lines)
    image = (origins + probe.depths_mm(rows)[:, None, None] * directions).reshape(-1, 3)
    origins, directions = probe.scan_lines(POINTS_PER_SIDE)
    points = (origins + probe.depths_mm(POINTS_PER_SIDE)[:, None, None] * directions).reshape(-1, 3)
    points = points @ pose[0, :3, :3].T + pose[0, :3, 3]
    exact = [float(np.sqrt(np.square(image - point).sum(axis=1).min())) for point in points]
    assert measured.nearest_mm[0, 0] == pytest.approx(np.mean(exact), rel=0.02)


def test_angle_is_the_rotation_to_the_nearest_view() -> None:
    views = np.concatenate([np.eye(4)[None], parallel(60.0)])
    measured = averaged(TrainingViews(views, LINEAR).measure(tilted(7.0), LINEAR))
    assert measured.angle_deg[0] == pytest.approx([7.0])


def test_of_two_views_as_near_the_less_turned_is_the_nearest() -> None:
    views = np.concatenate([in_plane(20.0), in_plane(5.0)])
    (angle_deg,) = averaged(TrainingViews(views, LINEAR).measure(np.eye(4)[None], LINEAR)).angle_deg
    assert 5.0 - 1e-6 <= angle_deg < 8.0  # the corners of the image lie in neither


def test_weights_are_those_of_the_views_around() -> None:
    views = TrainingViews(parallel(0.0, 2.0, 30.0), LINEAR)
    near, far = views.measure(parallel(0.0, 60.0), LINEAR).weights
    assert near.sum() == pytest.approx(1.0)
    assert near[0] > near[1] > 100 * near[2]
    assert far.argmax() == 2


def test_a_pose_that_is_not_rigid_is_refused() -> None:
    with pytest.raises(InvalidPose):
        TrainingViews(parallel(0.0), LINEAR).measure(2.0 * np.eye(4)[None], LINEAR)


def test_of_very_many_views_those_around_a_pose_count() -> None:
    """The nearest are found among ten times as many as are looked at, and the measures are those of all."""
    poses = parallel(*np.linspace(0.0, 100.0, 10 * MAX_VIEWS))
    near = np.abs(poses[:, 1, 3] - 40.0) < 5.0
    asked = parallel(40.013, 40.02, -8.0, 107.0)
    many, few = (TrainingViews(some, LINEAR).measure(asked, LINEAR) for some in (poses, poses[near]))
    for name in ("nearest_mm", "distance_mm", "interpolation_mm", "angle_deg"):
        np.testing.assert_allclose(getattr(many, name)[:2], getattr(few, name)[:2], atol=1e-9)
    assert many.nearest_mm[2:].mean(axis=1) == pytest.approx([8.0, 7.0])
    np.testing.assert_allclose(many.weights.sum(axis=1), 1.0)
