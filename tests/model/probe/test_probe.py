"""Probes: geometry by hand-computed values, limits, JSON, the released depth stretch."""

import math

import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe, PhasedProbe, Probe
from ultragray.contract import from_dict
from ultragray.errors import InvalidProbe
from ultragray.exchange.released_config import stretch_released_far

LINEAR = LinearProbe(width_mm=40.0, near_mm=10.0, far_mm=50.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=50.0, far_mm=150.0)
PHASED = PhasedProbe(opening_angle_deg=90.0, far_mm=120.0)


def test_rows_are_centres_of_equal_slices():
    np.testing.assert_allclose(LINEAR.depths_mm(4), [15.0, 25.0, 35.0, 45.0])
    np.testing.assert_allclose(CONVEX.depths_mm(1), [100.0])
    assert LINEAR.scan_line_length_mm == 40.0


def test_the_cull_ends_at_the_top_edge_of_the_last_row():
    assert LINEAR.cull_far_mm(4) == pytest.approx(40.0)
    assert LINEAR.cull_far_mm(1) == math.inf


def test_linear_scan_lines_are_parallel():
    origins, directions = LINEAR.scan_lines(4)
    np.testing.assert_allclose(origins, [[-15, 0, 0], [-5, 0, 0], [5, 0, 0], [15, 0, 0]])
    np.testing.assert_array_equal(directions, np.tile([0.0, 0.0, 1.0], (4, 1)))


def test_convex_scan_lines_fan_out_from_the_apex():
    origins, directions = CONVEX.scan_lines(3)
    assert not origins.any()
    angles = np.radians([-20.0, 0.0, 20.0])
    np.testing.assert_allclose(directions, np.stack([np.sin(angles), 0 * angles, np.cos(angles)], 1), atol=1e-15)


def test_corners():
    np.testing.assert_allclose(LINEAR.corners_mm(), [[-20, 0, 10], [20, 0, 10], [-20, 0, 50], [20, 0, 50]])
    corners = CONVEX.corners_mm()
    assert corners.shape == (6, 3)
    np.testing.assert_allclose(np.linalg.norm(corners, axis=1), [50, 50, 50, 150, 150, 150])
    np.testing.assert_allclose(np.degrees(np.arctan2(corners[:, 0], corners[:, 2])), [-30, 0, 30] * 2, atol=1e-12)


def test_a_phased_array_fans_out_from_the_centre_of_its_face():
    assert (PHASED.kind, PHASED.near_mm, PHASED.scan_line_length_mm) == ("phased", 0.0, 120.0)
    np.testing.assert_allclose(PHASED.depths_mm(3), [20.0, 60.0, 100.0])
    assert PHASED.cull_far_mm(3) == pytest.approx(80.0)
    origins, directions = PHASED.scan_lines(3)
    assert not origins.any()
    np.testing.assert_allclose(np.degrees(np.arctan2(directions[:, 0], directions[:, 2])), [-30, 0, 30], atol=1e-12)
    np.testing.assert_allclose(PHASED.lines.across(3), [-30, 0, 30], atol=1e-12)
    corners = PHASED.corners_mm()
    assert not corners[:3].any()
    side = 120.0 * math.sqrt(0.5)
    np.testing.assert_allclose(corners[3:], [[-side, 0, side], [0, 0, 120], [side, 0, side]], atol=1e-12)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: LinearProbe(0.0, 0.0, 50.0), "width_mm"),
        (lambda: LinearProbe(math.nan, 0.0, 50.0), "width_mm"),
        (lambda: LinearProbe(1e5, 0.0, 50.0), "width_mm"),
        (lambda: LinearProbe(40.0, -0.1, 50.0), "near_mm"),
        (lambda: LinearProbe(40.0, 50.0, 50.0), "far_mm"),
        (lambda: LinearProbe(40.0, 0.0, 0.0), "far_mm"),
        (lambda: ConvexProbe(near_mm=50.0, far_mm=150.0, opening_angle_deg=0.0), "opening_angle_deg"),
        (lambda: ConvexProbe(near_mm=50.0, far_mm=150.0, opening_angle_deg=175.1), "opening_angle_deg"),
        (lambda: ConvexProbe(near_mm=50.0, far_mm=50.0, opening_angle_deg=60.0), "far_mm"),
        (lambda: PhasedProbe(opening_angle_deg=0.0, far_mm=120.0), "opening_angle_deg"),
        (lambda: PhasedProbe(opening_angle_deg=90.0, far_mm=0.0), "far_mm"),
    ],
)
def test_probes_that_no_transducer_could_have_are_refused(make, field):
    with pytest.raises(InvalidProbe, match=f"^{field} must be") as caught:
        make()
    assert caught.value.field == field


def test_integers_become_floats_and_the_repr_is_what_one_writes():
    assert repr(LinearProbe(width_mm=40, near_mm=0, far_mm=50)) == (
        "LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)"
    )
    assert eval(repr(CONVEX)) == CONVEX
    assert repr(PHASED) == "PhasedProbe(opening_angle_deg=90.0, far_mm=120.0)"


@pytest.mark.parametrize(
    "document",
    [
        {"kind": "phased", "width_mm": 40, "near_mm": 0, "far_mm": 50},
        {"width_mm": 40, "near_mm": 0, "far_mm": 50},
        {"kind": "linear", "near_mm": 0, "far_mm": 50},
        {"kind": "linear", "width_mm": 40, "near_mm": 0, "far_mm": 50, "opening_angle_deg": 60},
        {"kind": "convex", "width_mm": 40, "near_mm": 0, "far_mm": 50},
        [],
        None,
        "linear",
        {"kind": ["linear"]},
    ],
)
def test_json_that_is_no_probe_is_refused(document):
    with pytest.raises(InvalidProbe):
        from_dict(Probe, document)


def test_the_stretch_puts_our_rows_on_the_released_grid():
    """The released code has row i at near + (far − near)·(i+½)/(H−1)."""
    near, far, height = 10.0, 50.0, 9
    stretched = LinearProbe(40.0, near, stretch_released_far(near, far, height))
    np.testing.assert_allclose(stretched.depths_mm(height), near + (far - near) * (np.arange(height) + 0.5) / 8)
    assert stretched.cull_far_mm(height) == pytest.approx(far)
    with pytest.raises(InvalidProbe, match="at least 2 rows"):
        stretch_released_far(near, far, 1)
