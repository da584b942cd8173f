"""Probes: what holds of every kind, geometry by hand-computed values, limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from skimage.transform import warp

from ultragray import ConvexProbe, LinearProbe, PhasedProbe, Probe, RadialProbe, SteeredProbe
from ultragray.contract import from_dict, to_dict
from ultragray.errors import InvalidProbe
from ultragray.exchange.released_config import stretch_released_far
from ultragray.geometry.scan_conversion import interpolated_frames, samples, scan_convert

PROBES = [
    *(member(**member.example()) for member in Probe.members.values()),
    LinearProbe(width_mm=40.0, near_mm=10.0, far_mm=50.0),
    PhasedProbe(opening_angle_deg=90.0, far_mm=120.0),
    SteeredProbe(width_mm=40.0, steering_deg=25.0, near_mm=5.0, far_mm=50.0),
    SteeredProbe(width_mm=40.0, steering_deg=-45.0, near_mm=0.0, far_mm=30.0),
]
each_probe = pytest.mark.parametrize("probe", PROBES, ids=str)


@each_probe
def test_pixels_lie_on_scan_lines(probe: Probe) -> None:
    origins, directions = probe.scan_lines(7)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    on_lines = origins + probe.depths_mm(5)[:, None, None] * directions
    rows, columns = np.meshgrid((np.arange(5) + 0.5) / 5, (np.arange(7) + 0.5) / 7, indexing="ij")
    np.testing.assert_allclose(probe.points_mm(rows, columns), on_lines, atol=1e-9)


@each_probe
def test_image_coordinates_and_back(probe: Probe) -> None:
    rows, columns = np.random.default_rng(0).uniform(0.01, 0.99, (2, 200))
    points = probe.points_mm(rows, columns)
    found = probe.image_coordinates(points[:, 0], points[:, 2])
    np.testing.assert_allclose(found, [rows, columns], atol=1e-9)
    (x, _, z), edges = points.T, probe.lines.edges
    assert (edges.scale * np.abs(x - edges.slope * z) - edges.across * z - edges.half <= 1e-9).all()
    depth = np.hypot(x, z) if edges.fanned else edges.by_z * z
    np.testing.assert_allclose(depth, probe.near_mm + rows * probe.scan_line_length_mm)


@each_probe
def test_points_outside_the_image_have_no_coordinates(probe: Probe) -> None:
    beyond = probe.ending_at(probe.far_mm + 10.0).points_mm(np.ones(9), np.linspace(0.0, 1.0, 9))
    assert np.isnan(probe.image_coordinates(beyond[:, 0], beyond[:, 2])).all()
    box = probe.box_mm
    assert np.isnan(probe.image_coordinates(np.array(box.right + 1.0), np.array(box.bottom + 1.0))).all()


@each_probe
def test_the_box_just_holds_the_image(probe: Probe) -> None:
    rows, columns = np.meshgrid(np.linspace(0, 1, 201), np.linspace(0, 1, 721))
    x, _, z = np.moveaxis(probe.points_mm(rows, columns), -1, 0)
    box = probe.box_mm
    np.testing.assert_allclose([x.min(), x.max(), z.min(), z.max()], box, atol=1e-3)


@each_probe
def test_a_mean_is_culled_by_its_depth(probe: Probe) -> None:
    last = (10 - 1) / 10
    points = probe.points_mm(np.array([0.001, last - 0.001, last + 0.001]), np.full(3, 0.3))
    np.testing.assert_array_equal(probe.cull(points[:, 0], points[:, 2], 10), [True, True, False])
    before = probe.points_mm(np.array([-0.01]), np.array([0.3]))
    assert not probe.cull(before[:, 0], before[:, 2], 10).any()


def test_between_pixels_each_place_has_its_frame_and_the_first_column_follows_the_last():
    frames = np.arange(24.0).reshape(2, 3, 4)
    which, rows = np.array([0, 1, 1, 0]), np.array([0.5, 1.0, 2.0, 1.0])
    columns = np.array([1.5, -0.25, 3.25, 0.0])
    expected = [(1.0 + 2.0 + 5.0 + 6.0) / 4.0, 0.25 * 19.0 + 0.75 * 16.0, 0.75 * 23.0 + 0.25 * 20.0, 4.0]
    assert interpolated_frames(frames, which, rows, columns).tolist() == expected


@each_probe
def test_scan_conversion_shows_each_pixel_where_it_lies(probe: Probe) -> None:
    """A frame that holds the z of its pixels, then their x, shows them."""
    height, width = 200, 360
    rows, columns = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    x, _, z = np.moveaxis(probe.points_mm(rows, columns), -1, 0)
    pixel_mm = probe.box_mm.longer_side / 150
    across, down = np.broadcast_arrays(*probe.picture(pixel_mm).positions_mm())
    shown_x, shown_z = scan_convert(x, probe, pixel_mm), scan_convert(z, probe, pixel_mm)
    rows, columns = probe.image_coordinates(across, down)
    margin = 0.0 if probe.lines.wrap else 1 / width
    inside = (rows > 1 / height) & (rows < 1 - 1 / height) & (columns >= margin) & (columns <= 1 - margin)
    tolerance = 2e-4 * probe.box_mm.longer_side
    np.testing.assert_allclose(shown_x[inside], across[inside], atol=tolerance)
    np.testing.assert_allclose(shown_z[inside], down[inside], atol=tolerance)
    assert not shown_x[np.isnan(rows)].any()


@each_probe
def test_json_and_repr_give_the_probe_back(probe: Probe) -> None:
    assert from_dict(Probe, to_dict(probe)) == probe
    assert to_dict(probe)["kind"] == probe.kind
    assert eval(repr(probe), {one.__name__: one for one in Probe.members.values()}) == probe


def test_the_first_radial_line_runs_along_z_and_the_next_towards_x():
    _, directions = RadialProbe(near_mm=1.0, far_mm=10.0).scan_lines(360)
    angles = np.degrees(np.arctan2(directions[:, 0], directions[:, 2])) % 360
    np.testing.assert_allclose(angles, np.arange(360) + 0.5)


def test_radial_scan_conversion_mixes_the_last_line_with_the_first():
    frame = np.zeros((20, 8))
    frame[:, 0], frame[:, 7] = 1.0, 1.0
    probe = RadialProbe(near_mm=1.0, far_mm=20.0)
    picture = scan_convert(frame, probe, 0.5)  # its middle column lies on the seam, below the centre
    assert picture.shape == (80, 80)
    np.testing.assert_allclose(picture[45:79, 39:41], 1.0)
    frame[:, 7] = 0.0
    assert (np.abs(scan_convert(frame, probe, 0.5)[60:79, 39:41].mean(axis=1) - 0.5) < 0.02).all()


def test_steered_lines_leave_the_face_at_their_angle():
    origins, directions = SteeredProbe(width_mm=40.0, steering_deg=30.0, near_mm=0.0, far_mm=50.0).scan_lines(4)
    np.testing.assert_allclose(origins, [[-15, 0, 0], [-5, 0, 0], [5, 0, 0], [15, 0, 0]])
    np.testing.assert_allclose(directions, np.tile([0.5, 0.0, np.sqrt(0.75)], (4, 1)))


def test_a_message_names_a_probe_in_words():
    assert f"{SteeredProbe(40.0, -15.0, 0.0, 50.0)}" == (
        "steered probe (width 40 mm, steering -15°, near 0 mm, far 50 mm)"
    )
    assert f"{RadialProbe(near_mm=1.5, far_mm=20.0)}" == "radial probe (near 1.5 mm, far 20 mm)"


LINEAR = LinearProbe(width_mm=40.0, near_mm=10.0, far_mm=50.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=50.0, far_mm=150.0)
PHASED = PhasedProbe(opening_angle_deg=90.0, far_mm=120.0)


def test_rows_are_centres_of_equal_slices():
    np.testing.assert_allclose(LINEAR.depths_mm(4), [15.0, 25.0, 35.0, 45.0])
    np.testing.assert_allclose(CONVEX.depths_mm(1), [100.0])
    assert LINEAR.scan_line_length_mm == 40.0


def test_corners():
    np.testing.assert_allclose(LINEAR.corners_mm(), [[-20, 0, 10], [20, 0, 10], [-20, 0, 50], [20, 0, 50]])
    corners = CONVEX.corners_mm()
    assert corners.shape == (6, 3)
    np.testing.assert_allclose(np.linalg.norm(corners, axis=1), [50, 50, 50, 150, 150, 150])
    np.testing.assert_allclose(np.degrees(np.arctan2(corners[:, 0], corners[:, 2])), [-30, 0, 30] * 2, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: LinearProbe(0.0, 0.0, 50.0), "width_mm"),
        (lambda: LinearProbe(math.nan, 0.0, 50.0), "width_mm"),
        (lambda: LinearProbe(40.0, -0.1, 50.0), "near_mm"),
        (lambda: LinearProbe(40.0, 50.0, 50.0), "far_mm"),
        (lambda: ConvexProbe(near_mm=50.0, far_mm=150.0, opening_angle_deg=175.1), "opening_angle_deg"),
        (lambda: PhasedProbe(opening_angle_deg=0.0, far_mm=120.0), "opening_angle_deg"),
        (lambda: PhasedProbe(opening_angle_deg=90.0, far_mm=0.0), "far_mm"),
    ],
)
def test_probes_that_no_transducer_could_have_are_refused(make, field):
    with pytest.raises(InvalidProbe, match=f"^{field} must be") as caught:
        make()
    assert caught.value.field == field


@pytest.mark.parametrize(
    "document",
    [
        {"kind": "phased", "width_mm": 40, "near_mm": 0, "far_mm": 50},
        {"kind": "linear", "width_mm": 40, "near_mm": 0, "far_mm": 50, "opening_angle_deg": 60},
        None,
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


def test_a_phased_frame_is_drawn_from_its_apex_on():
    picture = scan_convert(np.ones((64, 64)), PHASED, pixel_mm=1.0)
    assert picture.shape == (120, 170)
    assert picture[0].sum() <= 2  # the apex, at the top in the middle
    assert picture[60, 85] == 1.0
    angle = np.degrees(np.arctan2(np.arange(170) + 0.5 - 85, 30.5))
    np.testing.assert_array_equal(picture[30] > 0, np.abs(angle) <= 45)


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
