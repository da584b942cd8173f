"""The lengths that training follows."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.learn.training.geometry import Geometry, frame_spacing_mm


def test_lengths_of_a_straight_sweep(tiny_dataset):
    dataset = tiny_dataset(frames=9, spacing_mm=2.0)  # frames 2 and 6 are held out: 0 1 3 4 5 7 8 are left
    geometry = Geometry.of(dataset)
    assert geometry.frame_spacing_mm == pytest.approx(2.0)
    reach_mm = math.hypot(10.0, 8.0, 12.5)
    assert geometry.scene_scale_cm == pytest.approx(1.1 * reach_mm / 10.0)
    assert geometry.pixel_mm == pytest.approx(1.25)
    assert geometry.initial_scale_mm == pytest.approx(1.25)  # a pixel is more than half a spacing
    assert geometry.out_of_plane_mm == 0.0  # six frames cannot tell
    assert geometry.least_out_of_plane_mm(views_between=0.0) == pytest.approx(3.0)
    assert geometry.least_out_of_plane_mm(views_between=0.5) == 0.0
    assert (geometry.steps(0.75), geometry.steps(0.0)) == (500, 250)
    assert Geometry.of(tiny_dataset(frames=40)).steps(0.75) == 2 * 15 * 30
    assert geometry.initial_elevation_mm(0.0) == pytest.approx(2.0)
    assert geometry.initial_elevation_mm(9.0) == pytest.approx(4.5)


def test_dense_sweep_keeps_the_pixel(tiny_dataset):
    geometry = Geometry.of(tiny_dataset(spacing_mm=0.01))
    assert geometry.initial_scale_mm == geometry.initial_elevation_mm(0.0) == pytest.approx(geometry.pixel_mm)


def test_spacing_of_a_raster_is_that_across_the_frames(tiny_dataset):
    """Frames of the next lane lie in almost the same planes, but they are not neighbours."""
    sweep = tiny_dataset(frames=12, spacing_mm=1.0).train
    poses = np.concatenate([sweep.poses, sweep.poses])
    poses[len(sweep) :, 0, 3] += 30.0
    poses[len(sweep) :, 1, 3] += 0.1
    images = np.concatenate([sweep.images, sweep.images])
    both = replace(sweep, images=images, poses=poses, frame_numbers=np.arange(len(poses)))
    assert frame_spacing_mm(both) == pytest.approx(1.0)


def test_spacing_of_a_tilt_is_that_of_the_image_points(tiny_dataset):
    sweep = tiny_dataset(probe=LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=40.0)).train
    poses = np.tile(np.eye(4), (len(sweep), 1, 1))
    step = math.radians(1.0)
    for number, pose in enumerate(poses):
        c, s = math.cos(number * step), math.sin(number * step)
        pose[1:3, 1:3] = [[c, -s], [s, c]]
    expected = 20.0 * math.sin(step)  # mean of nothing at the face and 40 mm · sin at the far edge
    assert frame_spacing_mm(replace(sweep, poses=poses)) == pytest.approx(expected, rel=1e-3)
