"""Needles in frames: where the tip is, how bright the shaft, how dark its shadow, and the echoes behind it."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from ultragray import ElevationBeam, LinearProbe, RadialProbe, render
from ultragray.errors import InvalidArgument
from ultragray.rendering.tools import Needle, ToolFrame

from .conftest import LINEAR, PROBES

SIDE = 128
POSES_PER_PROBE = 40  # times five probes: 200
OUTPUTS = ("bmode", "echo", "transmittance", "labels")


def shown(scene, *needles, probe=LINEAR, side=SIDE, **more):
    return render(scene, probe, np.eye(4), height=side, width=side, outputs=OUTPUTS, tools=needles, **more)


def tilted(angle_deg, depth_mm=20.0, **material):
    """A needle through the middle of the image, 30 mm long, at an angle to its rows."""
    angle = np.radians(angle_deg)
    x, z = 15.0 * np.cos(angle), 15.0 * np.sin(angle)
    return Needle(tip_mm=(x, 0.0, depth_mm + z), hub_mm=(-x, 0.0, depth_mm - z), **material)


def middle(plane):  # [1, H, W] -> [H]
    return plane[0, :, plane.shape[2] // 2]


@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.kind)
def test_the_tip_is_within_one_pixel_of_the_projected_one_over_random_poses(empty_scene, random_poses, point_at, probe):
    random = np.random.default_rng(5)
    for pose in random_poses(POSES_PER_PROBE, seed=3, tilt_deg=180.0, shift_mm=200.0):
        row, column = random.uniform(0.25, 0.85, 2)
        hub_row, hub_column = row, column
        while abs(hub_row - row) + abs(hub_column - column) < 0.2:
            hub_row, hub_column = random.uniform(0.1, 0.9, 2)
        tip, hub = point_at(probe, pose, row, column), point_at(probe, pose, hub_row, hub_column)
        hub += random.uniform(-0.3, 0.3) * pose[:3, 1]  # a little out of the plane
        needle = Needle(tip_mm=tuple(tip), hub_mm=tuple(hub))
        np.testing.assert_allclose(needle.tip_in_image(probe, pose)[0], (row, column, 0.0), atol=1e-9)
        frames = render(empty_scene, probe, pose, height=SIDE, width=SIDE, outputs=("labels",), tools=(needle,))
        rows, columns = np.nonzero(frames["labels"][0].numpy() == needle.label)
        places = probe.points_mm((rows + 0.5) / SIDE, (columns + 0.5) / SIDE) @ pose[:3, :3].T + pose[:3, 3]
        away = np.maximum(abs(rows + 0.5 - SIDE * row), abs(columns + 0.5 - SIDE * column))
        assert away.min() <= 1.0
        beyond_mm = (tip - places) @ (hub - tip) / np.linalg.norm(hub - tip)
        pixel_mm = (
            max(probe.scan_line_length_mm, probe.lines.breadth_mm(probe.depths_mm(SIDE)[rows[away.argmin()]])) / SIDE
        )
        assert beyond_mm.max() <= pixel_mm


def test_a_needle_beside_the_slice_is_not_seen_and_a_thick_slice_shows_it(empty_scene):
    beside = Needle(tip_mm=(10.0, 2.0, 20.0), hub_mm=(-10.0, 2.0, 20.0))
    assert shown(empty_scene, beside)["bmode"].max() == 0.0
    thick = shown(empty_scene, beside, beam=ElevationBeam(4.0))
    assert 0.1 < thick["bmode"].max() < 0.9
    focused = shown(empty_scene, beside, beam=ElevationBeam(1.0, focus_mm=45.0, depth_of_field_mm=5.0))
    assert focused["bmode"].max() > 0.1
    sharp = shown(empty_scene, beside, beam=ElevationBeam(1.0, focus_mm=20.0, depth_of_field_mm=5.0))
    assert sharp["bmode"].max() < 0.1


def test_a_needle_through_the_plane_is_a_dot_with_a_shadow(empty_scene):
    through = Needle(tip_mm=(4.0, 10.0, 20.0), hub_mm=(4.0, -10.0, 20.0), diameter_mm=1.0)
    frames = shown(empty_scene, through, side=200)
    rows, columns = torch.nonzero(frames["labels"][0] == through.label, as_tuple=True)
    assert (columns.double().mean() + 0.5) * 0.2 - 20.0 == pytest.approx(4.0, abs=0.1)
    assert (rows.double().mean() + 0.5) * 0.25 == pytest.approx(20.0, abs=0.13)
    assert 4 <= columns.unique().numel() <= 6  # 1 mm of columns of 0.2 mm
    assert frames["transmittance"][0, -1].min() == pytest.approx(0.4, abs=1e-5)


def test_brightness_falls_off_away_from_perpendicular(empty_scene):
    found = [float(shown(empty_scene, tilted(angle))["echo"].max()) for angle in (0.0, 10.0, 20.0, 40.0, 60.0)]
    assert found[0] == pytest.approx(1.0, abs=0.02)
    assert all(steeper < flatter - 0.01 for flatter, steeper in pairwise(found))
    assert found[-1] == pytest.approx(0.25, abs=0.02)  # what a rough surface sends to all sides
    dim = shown(empty_scene, tilted(0.0, brightness=0.5))
    assert dim["echo"].max() == pytest.approx(0.5, abs=0.02)


def test_the_shadow_follows_the_opacity_and_the_path_through_the_shaft(empty_scene):
    for opacity in (0.3, 0.6, 0.9):
        for angle in (0.0, 30.0, 60.0):
            passed = middle(shown(empty_scene, tilted(angle, opacity=opacity))["transmittance"])
            assert passed[0] == 1.0
            assert passed[-1] == pytest.approx((1.0 - opacity) ** (1.0 / np.cos(np.radians(angle))), abs=1e-5)
    clear = shown(empty_scene, tilted(0.0, opacity=0.0, reverberation=0.0))
    assert (clear["transmittance"] == 1.0).all()


def test_the_echoes_of_the_comet_tail_are_a_diameter_apart_and_each_weaker(empty_scene):
    needle = tilted(0.0, depth_mm=12.0, diameter_mm=3.0, reverberation=0.5)
    bmode = middle(shown(empty_scene, needle, side=500)["bmode"]).numpy()
    peaks = [row for row in range(1, 499) if bmode[row - 1] < bmode[row] >= bmode[row + 1] and bmode[row] > 0.02]
    found = LINEAR.depths_mm(500)[peaks]
    np.testing.assert_allclose(found[:5], 12.0 + 3.0 * np.arange(5), atol=0.11)
    mirrored = 1.0 - needle.roughness
    np.testing.assert_allclose(bmode[peaks[1:5]], mirrored * 0.5 ** np.arange(1, 5), atol=0.02)
    without = middle(shown(empty_scene, tilted(0.0, reverberation=0.0), side=500)["bmode"]).numpy()
    assert without[LINEAR.depths_mm(500) > 21.0].max() < 1e-6


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 60.0])
def test_labels_are_as_thick_as_the_shaft_and_end_where_it_ends(empty_scene, angle_deg):
    needle = tilted(angle_deg, depth_mm=25.0, diameter_mm=3.0)
    labels = shown(empty_scene, needle, side=200)["labels"][0].numpy() == needle.label
    rows, columns = np.nonzero(labels)
    places = LINEAR.points_mm((rows + 0.5) / 200, (columns + 0.5) / 200)
    tip, hub = np.array(needle.tip_mm), np.array(needle.hub_mm)
    along, beside = (
        (places - tip) @ (hub - tip) / 30.0,
        np.linalg.norm(np.cross(places - tip, (hub - tip) / 30.0), axis=-1),
    )
    assert -0.3 < along.min() < 0.3
    assert -0.3 < 30.0 - along.max() < 0.3
    assert 1.3 < beside.max() < 1.8
    assert len(rows) * 0.2 * 0.25 == pytest.approx(30.0 * 3.0, rel=0.15)


def test_a_needle_of_the_probe_frame_moves_with_the_probe(empty_scene, random_poses):
    held = Needle(tip_mm=(8.0, 0.0, 30.0), hub_mm=(-15.0, 0.0, 5.0), frame=ToolFrame.PROBE)
    poses = random_poses(3, tilt_deg=90.0)
    frames = render(empty_scene, LINEAR, poses, height=SIDE, width=SIDE, outputs=OUTPUTS, tools=(held,))
    for name in OUTPUTS:
        assert torch.equal(frames[name][0], frames[name][1])
        assert torch.equal(frames[name][0], frames[name][2])
    assert frames["bmode"].max() > 0.2


def test_a_needle_around_a_catheter_is_seen_on_both_sides_of_its_first_line(empty_scene):
    probe = RadialProbe(near_mm=2.0, far_mm=30.0)
    across = Needle(tip_mm=(-8.0, 0.0, 15.0), hub_mm=(8.0, 0.0, 15.0))
    labels = shown(empty_scene, across, probe=probe)["labels"][0].numpy() == across.label
    touched = labels.any(axis=0)
    assert touched[:5].all()
    assert touched[-5:].all()
    assert not touched[SIDE // 4 : -SIDE // 4].any()
    rows = labels[:, 0].nonzero()[0]
    assert np.abs(probe.depths_mm(SIDE)[rows] - 15.0).max() < 0.5


def test_a_needle_without_direction_is_refused():
    with pytest.raises(InvalidArgument, match="hub_mm must differ from tip_mm"):
        Needle(tip_mm=(1.0, 2.0, 3.0), hub_mm=(1.0, 2.0, 3.0))
    with pytest.raises(InvalidArgument, match=r"tip_mm must be a list of 3 values"):
        Needle(tip_mm=(1.0, 2.0), hub_mm=(1.0, 2.0, 3.0))
    with pytest.raises(InvalidArgument, match="diameter_mm must be a finite number"):
        Needle(tip_mm=(1.0, 2.0, 3.0), hub_mm=(0.0, 0.0, 0.0), diameter_mm=0.0)


def test_needles_above_the_face_are_not_seen(empty_scene):
    above = LinearProbe(width_mm=40.0, near_mm=5.0, far_mm=50.0)
    entering = Needle(tip_mm=(10.0, 0.0, 20.0), hub_mm=(-20.0, 0.0, -20.0))
    passed = shown(empty_scene, entering, probe=above)["transmittance"][0, -1].numpy()
    columns = (np.arange(SIDE) + 0.5) / SIDE * 40.0 - 20.0
    assert (passed[columns < -5.2] == 1.0).all()  # where it is still out of the body
    assert (passed[(columns > -4.8) & (columns < 9.8)] < 0.5).all()
