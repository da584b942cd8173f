"""Cylinders and boxes in frames: their near side is bright, their inside is theirs, and the beam ends in them."""

import math

import numpy as np
import pytest
import torch

from ultragray import ElevationBeam, LinearProbe, render
from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import pose_from_position_quaternion
from ultragray.rendering.tools import Box, Cylinder, ScanView, ToolFrame

from .conftest import LINEAR, PROBES

SIDE = 200
OUTPUTS = ("bmode", "echo", "transmittance", "labels")
DEPTHS, COLUMNS = LINEAR.depths_mm(SIDE), (np.arange(SIDE) + 0.5) / SIDE * 40.0 - 20.0


def shown(scene, *tools, probe=LINEAR, **more):
    return render(scene, probe, np.eye(4), height=SIDE, width=SIDE, outputs=OUTPUTS, tools=tools, **more)


def labelled(frames, tool):  # [H, W]
    return frames["labels"][0].numpy() == tool.label


def turn(angle_deg):
    """About the elevation, from z towards +x."""
    half = math.radians(angle_deg) / 2.0
    return math.cos(half), 0.0, math.sin(half), 0.0


@pytest.mark.parametrize("angle_deg", [10.0, 30.0, 75.0])
def test_the_labels_of_a_turned_box_fill_it(empty_scene, angle_deg):
    box = Box(centre_mm=(0.0, 0.0, 25.0), size_mm=(20.0, 10.0, 6.0), quaternion=turn(angle_deg))
    angle = math.radians(angle_deg)
    x, z = np.broadcast_arrays(COLUMNS, DEPTHS[:, None] - 25.0)
    own_x, own_z = x * math.cos(angle) - z * math.sin(angle), x * math.sin(angle) + z * math.cos(angle)
    expected = (np.abs(own_x) < 10.0) & (np.abs(own_z) < 3.0)
    found = labelled(shown(empty_scene, box), box)
    assert (found != expected).sum() < 0.08 * expected.sum()


@pytest.mark.parametrize("kind", [Box, Cylinder])
def test_a_moved_tool_looks_as_its_frame_does_from_where_it_was(empty_scene, kind):
    if kind is Box:
        tool = Box(centre_mm=(3.0, 1.0, 25.0), size_mm=(16.0, 10.0, 6.0), quaternion=turn(20.0))
    else:
        tool = Cylinder(tip_mm=(4.0, 0.0, 25.0), hub_mm=(-9.0, 2.0, 20.0), diameter_mm=4.0)
    pose = pose_from_position_quaternion((400.0, -30.0, 90.0), (0.5, 0.5, -0.1, math.sqrt(0.49)))
    expected = shown(empty_scene, tool)
    led = render(empty_scene, LINEAR, pose, height=SIDE, width=SIDE, outputs=OUTPUTS, tools=(tool.moved(pose),))
    torch.testing.assert_close(led["labels"], expected["labels"])
    torch.testing.assert_close(led["echo"], expected["echo"], atol=1e-4, rtol=1e-4)
    assert labelled(led, tool).any()


def test_the_near_side_is_bright_and_the_inside_dark(empty_scene):
    box = Box(centre_mm=(0.0, 0.0, 25.0), size_mm=(16.0, 10.0, 6.0), reverberation=0.0)
    frames = shown(empty_scene, box)
    echo = frames["echo"][0, :, SIDE // 2].numpy()
    assert DEPTHS[echo.argmax()] == pytest.approx(22.0, abs=0.13)
    assert echo.max() == pytest.approx(1.0, abs=1e-5)
    assert echo[(DEPTHS > 23.0)].max() < 1e-4
    passed = frames["transmittance"][0, :, SIDE // 2].numpy()
    assert passed[DEPTHS < 21.8].min() == 1.0
    assert (np.diff(passed[(DEPTHS > 22.2) & (DEPTHS < 27.8)]) < 0).all()
    assert passed[DEPTHS > 28.2] == pytest.approx(0.4, abs=1e-5)


def test_a_cylinder_across_the_plane_is_a_disc(empty_scene):
    rod = Cylinder(tip_mm=(3.0, 20.0, 25.0), hub_mm=(3.0, -20.0, 25.0), diameter_mm=8.0, reverberation=0.0)
    frames = shown(empty_scene, rod)
    expected = np.hypot(COLUMNS - 3.0, DEPTHS[:, None] - 25.0) < 4.0
    assert (labelled(frames, rod) != expected).sum() < 0.08 * expected.sum()
    echo = frames["echo"][0].numpy()
    top = echo[:, np.argmin(np.abs(COLUMNS - 3.0))].max()
    side = echo[:, np.argmin(np.abs(COLUMNS - 6.0))].max()
    assert top > 0.95
    assert side < 0.5  # it is met at an angle there
    passed = frames["transmittance"][0, -1].numpy()
    assert passed[np.argmin(np.abs(COLUMNS - 3.0))] == pytest.approx(0.4, abs=0.01)
    assert passed[np.argmin(np.abs(COLUMNS - 6.5))] > 0.6  # a shorter way through it


def test_a_cylinder_along_the_plane_ends_where_its_ends_are(empty_scene):
    rod = Cylinder(tip_mm=(10.0, 0.0, 20.0), hub_mm=(-12.0, 0.0, 20.0), diameter_mm=4.0)
    found = labelled(shown(empty_scene, rod), rod)
    touched = COLUMNS[found.any(axis=0)]
    assert touched[0] == pytest.approx(-12.0, abs=0.2)
    assert touched[-1] == pytest.approx(10.0, abs=0.2)
    rows = DEPTHS[found[:, SIDE // 2]]
    assert rows[0] == pytest.approx(18.0, abs=0.3)
    assert rows[-1] == pytest.approx(22.0, abs=0.3)


def test_a_thick_slice_shows_the_edge_of_a_box_beside_the_plane(empty_scene):
    beside = Box(centre_mm=(0.0, 6.0, 25.0), size_mm=(16.0, 10.0, 6.0))  # it begins 1 mm beside
    assert shown(empty_scene, beside)["bmode"].max() == 0.0
    assert 0.1 < shown(empty_scene, beside, beam=ElevationBeam(5.0))["bmode"].max() < 0.7


@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.kind)
def test_a_disc_is_where_it_is_for_every_kind_of_probe(empty_scene, probe):
    middle = probe.points_mm(np.array(0.5), np.array(0.4))
    x, _, z = middle.tolist()
    rod = Cylinder(tip_mm=(x, 9.0, z), hub_mm=(x, -9.0, z), diameter_mm=6.0)
    frames = shown(empty_scene, rod, probe=probe)
    rows, columns = (np.arange(SIDE) + 0.5) / SIDE, (np.arange(SIDE) + 0.5) / SIDE
    places = probe.points_mm(*np.broadcast_arrays(rows[:, None], columns))
    expected = np.linalg.norm((places - middle)[..., [0, 2]], axis=-1) < 3.0
    assert expected.sum() > 150
    assert (labelled(frames, rod) != expected).sum() < 0.12 * expected.sum()


def test_a_face_within_a_box_sees_nothing_else():
    box = Box(centre_mm=(0.0, 0.0, 0.0), size_mm=(80.0, 80.0, 80.0), frame=ToolFrame.PROBE, opacity=0.999)
    probe = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=30.0)
    crossing = box.crossing(ScanView(probe, np.eye(4)[None], 8))
    assert (crossing.first_mm == 0.0).all()
    assert crossing.cover.sum(axis=0) == pytest.approx(1.0)


def test_a_box_that_is_not_turned_rightly_is_refused():
    with pytest.raises(InvalidArgument, match=r"quaternion must have norm 1 within 0\.001, got norm 0\.5") as told:
        Box(centre_mm=(0.0, 0.0, 0.0), size_mm=(1.0, 1.0, 1.0), quaternion=(0.5, 0.0, 0.0, 0.0))
    assert told.value.field == "quaternion"
    with pytest.raises(InvalidArgument, match=r"size_mm\[1\] must be a finite number from 0.05"):
        Box(centre_mm=(0.0, 0.0, 0.0), size_mm=(1.0, 0.0, 1.0))


def test_tools_behind_each_other_share_the_beam(empty_scene):
    upper = Box(centre_mm=(0.0, 0.0, 15.0), size_mm=(16.0, 10.0, 4.0), reverberation=0.0, label=1)
    lower = Box(centre_mm=(0.0, 0.0, 30.0), size_mm=(16.0, 10.0, 4.0), reverberation=0.0, label=2)
    both, other_way = shown(empty_scene, upper, lower), shown(empty_scene, lower, upper)
    column = both["bmode"][0, :, SIDE // 2].numpy()
    assert column[DEPTHS > 25.0].max() == pytest.approx(0.4, abs=1e-4)
    assert both["transmittance"][0, -1, SIDE // 2] == pytest.approx(0.16, abs=1e-4)
    for name in OUTPUTS:
        torch.testing.assert_close(both[name], other_way[name], atol=1e-6, rtol=0.0)
