"""How far image planes lie from each other."""

import math

import numpy as np

from ultragray.learn.sweep import corner_distances_mm


def test_distances_are_means_over_the_corners(make_sweep):
    corners = make_sweep(5, step_mm=0.3).corners_mm()
    np.testing.assert_allclose(corner_distances_mm(corners[:-1], corners[1:]), [0.3] * 4)
    np.testing.assert_allclose(corner_distances_mm(corners, corners[1]), [0.3, 0.0, 0.3, 0.6, 0.9], atol=1e-12)
    np.testing.assert_allclose(
        corner_distances_mm(corners[:2, None], corners[None]),
        0.3 * np.abs(np.arange(2)[:, None] - np.arange(5)),
        atol=1e-12,
    )


def test_a_turn_about_the_probe_moves_its_far_corners_only(make_sweep):
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 1:3, 1:3] = [[0.0, -1.0], [1.0, 0.0]]  # about the lateral axis
    upright, turned = make_sweep(2, poses=poses).corners_mm()
    np.testing.assert_allclose(corner_distances_mm(upright, turned), 50.0 * math.sqrt(2) / 2)
