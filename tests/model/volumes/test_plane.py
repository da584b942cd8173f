"""Slices as callers ask for them, as planes and as poses."""

import numpy as np
import pytest

from ultragray.errors import FrameTooCostly, InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.rendering.limits import GivenUp, Limits
from ultragray.rendering.settings import Encoding
from ultragray.rendering.volume_fields import sample_slice
from ultragray.rendering.volumes import SliceSettings

PLANE = SliceSettings(origin_mm=(3, -2, 10), right=(2, 1, 0), down=(0, 0, 4), size_mm=(12, 7.5), spacing_mm=0.5)


def test_the_pose_of_a_slice_leads_back_to_its_pixels():
    pose, grid = PLANE.pose(), PLANE.grid()
    np.testing.assert_allclose(check_poses(pose)[0], pose, atol=1e-12)  # rigid
    view = PLANE.view(Encoding.FLOAT32)
    again = view.grid(pose)
    assert again.shape == grid.shape == (24, 15, 1)
    np.testing.assert_allclose(again.affine, grid.affine, atol=1e-12)
    assert (view.picture.height, view.picture.width) == (view.height, view.width) == (15, 24)
    last = pose @ (view.picture.step[0] * 23, 0, view.picture.step[1] * 14, 1)
    np.testing.assert_allclose(last, grid.affine @ (23, 14, 0, 1), atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"field": "bmode"}, "field"),
        ({"right": (0, 0, 1)}, "down"),
        ({"down": (0, 0, 0)}, "down"),
        ({"size_mm": (0, 1)}, "size_mm"),
        ({"size_mm": (3.8e16, 3.1e299)}, "size_mm"),
        ({"size_mm": (1e6, 1e6)}, "spacing_mm"),
        ({"origin_mm": (0, -1e308, 0)}, "origin_mm"),
        ({"spacing_mm": 1e-9}, "spacing_mm"),
        ({"origin_mm": (0, 0)}, "origin_mm"),
        ({"origin_mm": (0, 0, float("nan"))}, "origin_mm[2]"),
    ],
)
def test_planes_that_cannot_be_are_refused(changes, field):
    with pytest.raises(InvalidArgument) as caught:
        SliceSettings(**{"origin_mm": (0, 0, 0), "size_mm": (10, 10), **changes})
    assert caught.value.field == field


@pytest.mark.parametrize("length", [5e-324, 1e-200, 1e200, 1.7e308])
def test_a_direction_may_have_any_length(length):
    grid = SliceSettings(origin_mm=(0, 0, 0), size_mm=(10, 10), right=(0, length, 0), down=(length, 0, 0)).grid()
    np.testing.assert_array_equal(grid.axes, [[0, 1, 0], [1, 0, 0], [0, 0, -1]])


def test_a_slice_is_bound_by_its_cost_and_ends_where_it_is_given_up(random_scene):
    scene = random_scene(100)
    grid = SliceSettings(origin_mm=(-20, 0, 0), size_mm=(40, 40)).grid()
    assert sample_slice(scene, "echo", grid, Limits(10**9)).any()
    with pytest.raises(FrameTooCostly, match="footprint pixels"):
        sample_slice(scene, "echo", grid, Limits(1000))
    with pytest.raises(GivenUp):
        sample_slice(scene, "echo", grid, Limits(flag=np.array([7]), number=7))
