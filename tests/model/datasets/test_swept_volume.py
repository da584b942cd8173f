"""How many voxels the planes of a sweep cross."""

import math

import pytest

from ultragray import ConvexProbe
from ultragray.datasets.checks import MAX_VOXELS, swept_volume


@pytest.mark.parametrize(("step_mm", "coverage"), [(0.5, 1.0), (2.0, 0.5), (4.0, 0.25)])
def test_coverage_falls_with_the_spacing(make_sweep, step_mm, coverage):
    swept = swept_volume(make_sweep(round(40 / step_mm) + 1, step_mm=step_mm))
    assert swept.voxel_mm == 1.0
    assert swept.coverage == pytest.approx(coverage, abs=0.03)
    assert swept.swept_ml == pytest.approx(40 * 40 * 50 * swept.coverage / 1000)


def test_a_fan_crosses_the_voxels_of_its_sector(make_sweep):
    probe = ConvexProbe(opening_angle_deg=60.0, near_mm=40.0, far_mm=100.0)
    swept = swept_volume(make_sweep(21, step_mm=0.5, probe=probe))
    assert swept.swept_ml == pytest.approx(math.radians(60) / 2 * (100**2 - 40**2) * 10 / 1000, rel=0.04)


def test_it_does_not_depend_on_the_frame_of_the_tracker(make_sweep, random_poses):
    sweep = make_sweep(21)
    turned = make_sweep(21, poses=random_poses(1, tilt_deg=170.0) @ sweep.poses)
    assert swept_volume(turned).swept_ml == pytest.approx(swept_volume(sweep).swept_ml, rel=0.02)


def test_huge_volumes_get_larger_voxels(make_sweep):
    swept = swept_volume(make_sweep(3, step_mm=100_000.0))
    voxels = math.prod(math.ceil(side_mm / swept.voxel_mm) for side_mm in (40, 50, 200_000))
    assert 0.9 * MAX_VOXELS < voxels <= MAX_VOXELS


def test_flat_boxes_keep_the_limit_too(make_sweep):
    """Two poses far off, in the plane of the others: one layer of voxels."""
    poses = make_sweep(4, step_mm=0.0).poses.copy()
    poses[2, 0, 3], poses[3, 2, 3] = 100_000.0, 100_000.0
    swept = swept_volume(make_sweep(4, poses=poses))
    voxels = math.prod(math.ceil(side_mm / swept.voxel_mm) for side_mm in (100_000, 100_000))
    assert 0.9 * MAX_VOXELS < voxels <= MAX_VOXELS
