"""Scan conversion: what lies where in a picture with square pixels."""

import math

import numpy as np
import pytest
from skimage.transform import warp

from ultragray import ConvexProbe, LinearProbe, PhasedProbe
from ultragray.geometry.scan_conversion import samples, scan_convert, scan_convert_labels

CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=50.0, far_mm=150.0)
PHASED = PhasedProbe(opening_angle_deg=90.0, far_mm=120.0)


def test_a_phased_frame_is_drawn_from_its_apex_on():
    picture = scan_convert(np.ones((64, 64)), PHASED, pixel_mm=1.0)
    assert picture.shape == (120, 170)
    assert picture[0].sum() <= 2  # the apex, at the top in the middle
    assert picture[60, 85] == 1.0
    angle = np.degrees(np.arctan2(np.arange(170) + 0.5 - 85, 30.5))
    np.testing.assert_array_equal(picture[30] > 0, np.abs(angle) <= 45)


def test_labels_are_drawn_without_mixing_them():
    labels = np.zeros((40, 40), np.uint8)
    labels[:, 20:] = 200
    labels[20:, :20] = 7
    for probe in (CONVEX, PHASED):
        picture = scan_convert_labels(labels, probe, pixel_mm=0.7)
        assert picture.dtype == np.uint8
        assert set(np.unique(picture)) == {0, 7, 200}
        drawn = scan_convert(labels == 200, probe, pixel_mm=0.7)
        assert picture.shape == drawn.shape
        np.testing.assert_array_equal(picture[drawn == 1.0], 200)
        np.testing.assert_array_equal(picture[drawn == 0.0] == 200, False)


def test_scan_conversion_puts_range_and_angle_where_they_are():
    """A frame whose pixels hold their own range, then their own angle, shows them at the right places."""
    height, width, pixel_mm = 200, 180, 0.5
    ranges = np.tile(CONVEX.depths_mm(height)[:, None], (1, width))
    angles = np.tile(CONVEX.lines.across(width)[None], (height, 1))
    shown_range = scan_convert(ranges, CONVEX, pixel_mm)
    shown_angle = scan_convert(angles, CONVEX, pixel_mm)
    rows, columns = shown_range.shape
    assert columns == math.ceil(2 * 150 * math.sin(math.radians(30)) / pixel_mm)
    assert rows == math.ceil((150 - 50 * math.cos(math.radians(30))) / pixel_mm)
    x = (np.arange(columns) + 0.5) * pixel_mm - columns * pixel_mm / 2
    z = 50 * math.cos(math.radians(30)) + (np.arange(rows) + 0.5) * pixel_mm
    r = np.hypot(x[None], z[:, None])
    theta = np.degrees(np.arctan2(x[None], z[:, None]))
    well_inside = (r > 51) & (r < 149) & (np.abs(theta) < 29.5)
    np.testing.assert_allclose(shown_range[well_inside], r[well_inside], atol=0.01)
    np.testing.assert_allclose(shown_angle[well_inside], theta[well_inside], atol=0.01)
    outside = (r < 50) | (r > 150) | (np.abs(theta) > 30)
    assert not shown_range[outside].any()


@pytest.mark.parametrize("probe", [CONVEX, PHASED, LinearProbe(40.0, 0.0, 50.0)])
def test_pixels_are_interpolated_as_scikit_image_does(probe):
    frame = np.random.default_rng(0).random((60, 50))
    rows, columns, inside = samples(probe, frame.shape, 0.9)
    expected = np.where(inside, warp(frame, np.stack([rows, columns]), order=1, mode="edge"), 0.0)
    np.testing.assert_allclose(scan_convert(frame, probe, 0.9), expected, atol=1e-6)


def test_scan_conversion_of_one_pixel():
    picture = scan_convert(np.ones((1, 1)), CONVEX, 5.0)
    assert picture.dtype == np.float32
    assert set(np.unique(picture)) == {0.0, 1.0}
