"""Tools, alone and in frames of tissue on every backend; ghosts, the mirror images beyond a strong interface."""

import json
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, ElevationBeam, LinearProbe, PhasedProbe, RadialProbe, SteeredProbe, render
from ultragray.contract import from_dict, to_dict
from ultragray.errors import InvalidArgument, UnknownOutput
from ultragray.geometry.pose import pose_from_position_quaternion
from ultragray.rendering.outputs import PLANES
from ultragray.rendering.overlays import LEAST_DEPTH_MM, add_ghosts
from ultragray.rendering.settings import Contact, FrameSettings
from ultragray.rendering.tools import MAX_TOOLS, Box, Cylinder, Needle, ScanView, ToolFrame, load_tools
from ultragray.scene.info import SceneInfo

LINEAR = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
ORIGIN = np.eye(4)
PROBES = (
    LINEAR,
    SteeredProbe(width_mm=40.0, steering_deg=20.0, near_mm=0.0, far_mm=50.0),
    ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=80.0),
    PhasedProbe(opening_angle_deg=80.0, far_mm=60.0),
    RadialProbe(near_mm=5.0, far_mm=45.0),
)


@pytest.fixture(scope="session")
def empty_scene(random_scene):
    """A scene without anything in sight: echo 0, transmittance 1."""
    return random_scene(1, centre_cm=(0.0, 0.0, -500.0))


@pytest.fixture(scope="session")
def point_at():
    def find(probe, pose, row, column):  # [3] mm in the scene frame
        """The point of the image plane at a row and a column, from 0 to 1."""
        return pose[:3, :3] @ probe.points_mm(np.array(row), np.array(column)) + pose[:3, 3]

    return find


TOOLS = (
    Needle(tip_mm=(1.0, 2.0, 3.0), hub_mm=(4.0, 5.0, 6.0), label=3),
    Cylinder(tip_mm=(1.0, 2.0, 3.0), hub_mm=(4.0, 5.0, 6.0), diameter_mm=4.0, frame=ToolFrame.PROBE),
    Box(centre_mm=(0.0, 0.0, 30.0), size_mm=(3.0, 2.0, 1.0), quaternion=(0.0, 1.0, 0.0, 0.0)),
)


def test_a_file_gives_back_the_tools_that_were_written(tmp_path):
    path = tmp_path / "tools.json"
    path.write_text(json.dumps(to_dict(TOOLS)))
    assert load_tools(path) == TOOLS
    path.write_text("[]")
    assert load_tools(path) == ()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "it must hold a list of tools, got {}"),
        ("[1]", r"tools\[0\] must be an object, got 1"),
        ("[", "Expecting value"),
        ("[" * 100_000, "recursion"),
        ('[{"kind": "saw"}]', r"tools\[0\].kind must be one of box, cylinder, needle, got 'saw'"),
        ('[{"kind": "box", "centre_mm": [0, 0, 0]}]', r"tools\[0\].size_mm is required by the tool box"),
        ('[{"kind": "box", "centre_mm": [0, 0, NaN], "size_mm": [1, 1, 1]}]', r"tools\[0\].centre_mm\[2\] must be a"),
    ],
)
def test_what_is_no_file_of_tools_is_refused(tmp_path, text, words):
    path = tmp_path / "tools.json"
    path.write_text(text)
    with pytest.raises(InvalidArgument, match=words) as told:
        load_tools(path)
    assert told.value.detail.startswith(f"{path}: ")
    with pytest.raises(InvalidArgument, match="no such file"):
        load_tools(tmp_path / "other.json")


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: FrameSettings(tools=TOOLS * 3), f"tools must be a list of at most {MAX_TOOLS} values, got 9"),
        (lambda: FrameSettings(tools=(TOOLS[0], None)), r"tools\[1\] must be a Tool"),
        (lambda: FrameSettings(tools=(TOOLS[0], {"kind": "needle"})), r"tools\[1\] must be a Tool"),
        (lambda: from_dict(FrameSettings, {"tools": [to_dict(TOOLS[0]) | {"opacity": 1.0}]}), "a .* from 0 to 0.999"),
        (lambda: FrameSettings(ghost=1.5), "ghost must be a finite number from 0 to 1"),
        (lambda: Needle(tip_mm=(1.0, 2.0, 3.0), hub_mm=(1.0, 2.0, 3.0)), "hub_mm must differ from tip_mm"),
        (lambda: replace(TOOLS[2], quaternion=(0.5, 0.0, 0.0, 0.0)), r"quaternion must have norm 1 .*, got norm 0\.5"),
    ],
)
def test_tools_that_cannot_be_are_refused(make, told):
    with pytest.raises(InvalidArgument, match=told):
        make()


SIDE = 128
POSES_PER_PROBE = 12
OUTPUTS = ("bmode", "echo", "transmittance", "labels")


THIN = ElevationBeam(0.05)  # thinner than every needle


def shown(scene, *tools, probe=LINEAR, pose=ORIGIN, side=SIDE, **more):
    return render(scene, probe, pose, height=side, width=side, outputs=OUTPUTS, tools=tools, **more)


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
    assert shown(empty_scene, beside, beam=THIN)["bmode"].max() == 0.0
    far_beside = replace(beside, tip_mm=(10.0, 5.0, 20.0), hub_mm=(-10.0, 5.0, 20.0))
    assert shown(empty_scene, far_beside)["bmode"].max() == 0.0
    thick = shown(empty_scene, beside, beam=ElevationBeam(4.0))
    assert 0.1 < thick["bmode"].max() < 0.9
    focused = shown(empty_scene, beside, beam=ElevationBeam(1.0, focus_mm=45.0, depth_of_field_mm=5.0))
    assert focused["bmode"].max() > 0.1
    sharp = shown(empty_scene, beside, beam=ElevationBeam(1.0, focus_mm=20.0, depth_of_field_mm=5.0))
    assert sharp["bmode"].max() < 0.1


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
            passed = middle(shown(empty_scene, tilted(angle, opacity=opacity), beam=THIN)["transmittance"])
            assert passed[0] == 1.0
            assert passed[-1] == pytest.approx((1.0 - opacity) ** (1.0 / np.cos(np.radians(angle))), abs=1e-3)
    clear = shown(empty_scene, tilted(0.0, opacity=0.0, reverberation=0.0))
    assert (clear["transmittance"] == 1.0).all()


@pytest.mark.parametrize(("beam", "width_mm"), [(None, 2.5), (ElevationBeam(4.0), 4.0), (THIN, 0.1 * 2.3548)])
@pytest.mark.parametrize("diameter_mm", [0.7, 2.0])
def test_a_needle_takes_from_the_beam_the_share_of_its_width_that_it_fills(empty_scene, beam, width_mm, diameter_mm):
    filled = math.erf(0.5 * diameter_mm / (math.sqrt(2.0) * width_mm / 2.3548))
    frames = shown(empty_scene, tilted(0.0, diameter_mm=diameter_mm, opacity=0.8), beam=beam)
    assert middle(frames["transmittance"])[-1] == pytest.approx(1.0 - 0.8 * filled, abs=1e-4)
    assert frames["echo"].max() == pytest.approx(1.0, abs=0.02)  # met head on in the middle of the beam


def test_a_needle_across_the_plane_fills_the_width_of_the_beam(empty_scene):
    across = Needle(tip_mm=(0.0, 20.0, 20.0), hub_mm=(0.0, -20.0, 20.0), opacity=0.8)
    passed = shown(empty_scene, across)["transmittance"]
    assert passed.min() == pytest.approx(0.2, abs=1e-4)
    half = Needle(tip_mm=(0.0, 0.0, 20.0), hub_mm=(0.0, -20.0, 20.0), opacity=0.8)
    assert shown(empty_scene, half)["transmittance"].min() == pytest.approx(0.6, abs=0.12)  # its tip in the plane


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


SOLID_SIDE = 200
DEPTHS, COLUMNS = LINEAR.depths_mm(SOLID_SIDE), (np.arange(SOLID_SIDE) + 0.5) / SOLID_SIDE * 40.0 - 20.0


def solids_shown(scene, *tools, **more):
    return shown(scene, *tools, side=SOLID_SIDE, **more)


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
    found = labelled(solids_shown(empty_scene, box), box)
    assert (found != expected).sum() < 0.08 * expected.sum()


@pytest.mark.parametrize("kind", [Box, Cylinder])
def test_a_moved_tool_looks_as_its_frame_does_from_where_it_was(empty_scene, kind):
    if kind is Box:
        tool = Box(centre_mm=(3.0, 1.0, 25.0), size_mm=(16.0, 10.0, 6.0), quaternion=turn(20.0))
    else:
        tool = Cylinder(tip_mm=(4.0, 0.0, 25.0), hub_mm=(-9.0, 2.0, 20.0), diameter_mm=4.0)
    pose = pose_from_position_quaternion((400.0, -30.0, 90.0), (0.5, 0.5, -0.1, math.sqrt(0.49)))
    expected = solids_shown(empty_scene, tool)
    led = solids_shown(empty_scene, tool.moved(pose), pose=pose)
    torch.testing.assert_close(led["labels"], expected["labels"])
    torch.testing.assert_close(led["echo"], expected["echo"], atol=1e-4, rtol=1e-4)
    assert labelled(led, tool).any()


def test_the_near_side_is_bright_and_the_inside_dark(empty_scene):
    box = Box(centre_mm=(0.0, 0.0, 25.0), size_mm=(16.0, 10.0, 6.0), reverberation=0.0)
    frames = solids_shown(empty_scene, box)
    echo = frames["echo"][0, :, SOLID_SIDE // 2].numpy()
    assert DEPTHS[echo.argmax()] == pytest.approx(22.0, abs=0.13)
    assert echo.max() == pytest.approx(1.0, abs=1e-5)
    assert echo[(DEPTHS > 23.0)].max() < 1e-4
    passed = frames["transmittance"][0, :, SOLID_SIDE // 2].numpy()
    assert passed[DEPTHS < 21.8].min() == 1.0
    assert (np.diff(passed[(DEPTHS > 22.2) & (DEPTHS < 27.8)]) < 0).all()
    assert passed[DEPTHS > 28.2] == pytest.approx(0.4, abs=1e-5)


@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.kind)
def test_a_disc_is_where_it_is_for_every_kind_of_probe(empty_scene, probe):
    middle = probe.points_mm(np.array(0.5), np.array(0.4))
    x, _, z = middle.tolist()
    rod = Cylinder(tip_mm=(x, 9.0, z), hub_mm=(x, -9.0, z), diameter_mm=6.0)
    frames = solids_shown(empty_scene, rod, probe=probe)
    rows, columns = (np.arange(SOLID_SIDE) + 0.5) / SOLID_SIDE, (np.arange(SOLID_SIDE) + 0.5) / SOLID_SIDE
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


def test_tools_behind_each_other_share_the_beam(empty_scene):
    upper = Box(centre_mm=(0.0, 0.0, 15.0), size_mm=(16.0, 10.0, 4.0), reverberation=0.0, label=1)
    lower = Box(centre_mm=(0.0, 0.0, 30.0), size_mm=(16.0, 10.0, 4.0), reverberation=0.0, label=2)
    both, other_way = solids_shown(empty_scene, upper, lower), solids_shown(empty_scene, lower, upper)
    column = both["bmode"][0, :, SOLID_SIDE // 2].numpy()
    assert column[DEPTHS > 25.0].max() == pytest.approx(0.4, abs=1e-4)
    assert both["transmittance"][0, -1, SOLID_SIDE // 2] == pytest.approx(0.16, abs=1e-4)
    for name in OUTPUTS:
        torch.testing.assert_close(both[name], other_way[name], atol=1e-6, rtol=0.0)


SIZE = {"height": 60, "width": 50}


def tools_of(probe):
    """One of each kind, across the image plane of a probe, in its frame."""

    def at(row, column):
        x, y, z = probe.points_mm(np.array(row), np.array(column)).tolist()
        return x, y, z

    x, _, z = at(0.5, 0.7)
    return (
        Needle(tip_mm=at(0.7, 0.6), hub_mm=at(0.1, 0.2), frame=ToolFrame.PROBE, label=1),
        Box(centre_mm=at(0.4, 0.45), size_mm=(6.0, 4.0, 2.0), frame=ToolFrame.PROBE, label=2),
        Cylinder(tip_mm=(x, -8.0, z), hub_mm=(x, 8.0, z), diameter_mm=5.0, frame=ToolFrame.PROBE, label=3),
    )


@pytest.fixture(scope="module")
def scene(random_scene):
    made = random_scene(400, extent_cm=(8.0, 2.0, 9.0), info={"probe": LINEAR})
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 1, 3] = np.linspace(-8.0, 8.0, 9)
    return replace(made, training_poses=poses)


@pytest.mark.parametrize("ghost", [0.0, 0.5])
@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.kind)
def test_bmode_stays_echo_times_transmittance_and_amounts_stay_amounts(scene, random_poses, probe, ghost):
    poses = random_poses(2)
    more = {"tools": tools_of(probe), "beam": ElevationBeam(3.0), "ghost": ghost}
    frames = render(scene, probe, poses, **SIZE, outputs=(*PLANES, "labels", "attenuation"), **more)
    plain = render(scene, probe, poses, **SIZE, beam=ElevationBeam(3.0))
    torch.testing.assert_close(frames["bmode"], frames["echo"] * frames["transmittance"], atol=1e-5, rtol=0.0)
    for name in (*PLANES, "attenuation"):
        assert torch.isfinite(frames[name]).all()
        assert frames[name].min() >= 0.0
        assert frames[name].max() <= 1.0 + 1e-6
    assert set(frames["labels"].unique().tolist()) == {0, 1, 2, 3}
    assert (frames["bmode"] - plain["bmode"]).abs().max() > 0.2
    for name in PLANES:  # an output is the same, whatever else is asked for
        alone = render(scene, probe, poses, **SIZE, outputs=(name,), **more)
        torch.testing.assert_close(alone[name], frames[name], atol=1e-6, rtol=0.0)


def test_lines_that_meet_no_tool_keep_their_bytes(scene):
    needle = Needle(tip_mm=(0.0, 0.0, 30.0), hub_mm=(-10.0, 0.0, 10.0))
    plain = render(scene, LINEAR, np.eye(4), **SIZE)
    frames = render(scene, LINEAR, np.eye(4), **SIZE, tools=(needle,))
    beside = [column for column in range(50) if not -12.0 < (column + 0.5) * 0.8 - 20.0 < 2.0]
    for name in PLANES:
        assert torch.equal(frames[name][:, :, beside], plain[name][:, :, beside])
        assert not torch.equal(frames[name], plain[name])


@pytest.mark.slow
def test_the_cuda_backend_draws_the_same(random_scene, on_device, assert_agrees):
    pytest.importorskip("triton", reason="the package triton is not installed, which runs these kernels")
    small = random_scene(40, sigma_cm=(0.05, 0.3))
    asked = {"height": 24, "width": 20, "outputs": (*PLANES, "labels"), "tools": tools_of(LINEAR), "ghost": 0.5}
    expected = render(small, LINEAR, np.eye(4), **asked, backend="reference")
    found = render(on_device(small), LINEAR, np.eye(4), **asked, backend="cuda")
    assert_agrees(found, {name: expected[name].numpy() for name in PLANES}, tolerance=5e-4)
    assert torch.equal(found["labels"].cpu(), expected["labels"])


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_gradients_reach_the_scene_and_the_pose(scene, backend):
    pose = torch.eye(4, dtype=torch.float64)[None].requires_grad_()
    leaf = replace(scene, sh0=scene.sh0.clone().requires_grad_())
    more = {"tools": tools_of(LINEAR), "ghost": 0.3, "backend": backend}
    frames = render(leaf, LINEAR, pose, **SIZE, outputs=("bmode", "echo"), **more)
    (frames["bmode"].sum() + frames["echo"].sum()).backward()
    for tensor in (pose, leaf.sh0):
        assert torch.isfinite(tensor.grad).all()
        assert float(tensor.grad.norm()) > 0
    plain = replace(scene, sh0=scene.sh0.clone().requires_grad_())
    render(plain, LINEAR, np.eye(4), **SIZE, outputs=("bmode",), backend=backend)["bmode"].sum().backward()
    assert leaf.sh0.grad is not None
    assert not torch.equal(plain.sh0.grad, leaf.sh0.grad)  # shadows take light from what lies in them


def test_labels_of_tools_lie_over_those_of_the_tissue(scene):
    needle = Needle(tip_mm=(5.0, 0.0, 30.0), hub_mm=(-10.0, 0.0, 10.0), label=9)
    asked = {**SIZE, "outputs": ("labels",)}
    with pytest.raises(UnknownOutput, match="labels"):
        render(scene, LINEAR, np.eye(4), **asked)
    alone = render(scene, LINEAR, np.eye(4), **asked, tools=(needle,))["labels"]
    assert set(alone.unique().tolist()) == {0, 9}
    labelled = replace(
        scene,
        labels=torch.full((len(scene.means),), 2, dtype=torch.uint8),
        info=replace(scene.info, label_names={2: "bone"}),
    )
    tissue = render(labelled, LINEAR, np.eye(4), **asked)["labels"]
    both = render(labelled, LINEAR, np.eye(4), **asked, tools=(needle,))["labels"]
    assert torch.equal(both == 9, alone == 9)
    assert torch.equal(both[both != 9], tissue[both != 9])
    assert isinstance(labelled.info, SceneInfo)


def test_a_tool_is_rigid_under_pressure(scene, empty_scene):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, 2, 3], poses[2, 2, 3] = 5.0, 2.0  # pressed in
    empty = replace(empty_scene, training_poses=scene.training_poses, info=replace(empty_scene.info, probe=LINEAR))
    needle = Needle(tip_mm=(5.0, 0.0, 30.0), hub_mm=(-10.0, 0.0, 12.0))
    asked = {**SIZE, "outputs": ("labels", "transmittance"), "tools": (needle,)}
    expected = render(empty, None, poses, **asked)
    pressed = render(empty, None, poses, **asked, contact=Contact.PRESSURE)
    assert pressed.pressing.indentation_mm.max() > 4.0
    for name in ("labels", "transmittance"):
        assert torch.equal(pressed[name], expected[name])


def test_lines_off_the_skin_show_no_tool(scene):
    lifted = np.eye(4)
    lifted[2, 3] = -5.0
    needle = Needle(tip_mm=(5.0, 0.0, 20.0), hub_mm=(-10.0, 0.0, 8.0), frame=ToolFrame.PROBE)
    frames = render(scene, None, lifted, **SIZE, tools=(needle,), contact=Contact.AIR, ghost=0.5)
    assert frames["bmode"].max() == 0.0
    assert frames["transmittance"].max() == 0.0


SQUARE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
GHOST_SIDE = 100  # rows of half a millimetre
INTERFACE, TARGET = 40, 25


def tissue(interface=0.8):
    """Grey tissue with a bright target above a bright interface, behind which half of the beam is left."""
    echo, transmittance = torch.full((1, GHOST_SIDE, GHOST_SIDE), 0.2), torch.ones(1, GHOST_SIDE, GHOST_SIDE)
    echo[:, TARGET, 40:60] = 0.5
    echo[:, INTERFACE] = interface
    transmittance[:, INTERFACE + 1 :] = 0.5
    return {"echo": echo, "transmittance": transmittance, "bmode": echo * transmittance}


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_the_ghost_of_a_target_is_as_far_beyond_the_interface_as_the_target_is_before_it(share):
    planes, before = tissue(), tissue()
    add_ghosts(planes, SQUARE, share)
    ghost = 2 * INTERFACE - TARGET
    assert planes["bmode"][0, ghost, 50] == pytest.approx((1 - share) * 0.1 + share * 0.5)
    assert planes["bmode"][0, ghost, 10] == pytest.approx((1 - share) * 0.1 + share * 0.2)
    assert planes["transmittance"][0, ghost, 50] == pytest.approx((1 - share) * 0.5 + share * 1.0)
    torch.testing.assert_close(planes["bmode"], planes["echo"] * planes["transmittance"])
    for name, plane in planes.items():
        assert torch.equal(plane[:, : INTERFACE + 1], before[name][:, : INTERFACE + 1])
        assert torch.equal(plane[:, 2 * INTERFACE + 1 :], before[name][:, 2 * INTERFACE + 1 :])


def test_a_weak_interface_mirrors_nothing():
    planes, before = tissue(interface=0.55), tissue(interface=0.55)
    add_ghosts(planes, SQUARE, 0.5)
    for name, plane in planes.items():
        assert torch.equal(plane, before[name])


def test_bright_lines_at_the_face_mirror_nothing():
    planes, before = tissue(interface=0.2), tissue(interface=0.2)
    for one in (planes, before):
        rows = SQUARE.depths_mm(GHOST_SIDE) < LEAST_DEPTH_MM
        one["echo"][:, rows] = one["bmode"][:, rows] = 0.9
    add_ghosts(planes, SQUARE, 0.5)
    for name, plane in planes.items():
        assert torch.equal(plane, before[name])


def test_an_interface_runs_on_through_its_gaps():
    planes, whole = tissue(), tissue()
    planes["echo"][:, INTERFACE, 30] = planes["bmode"][:, INTERFACE, 30] = 0.2
    add_ghosts(planes, SQUARE, 0.5)
    add_ghosts(whole, SQUARE, 0.5)
    assert torch.equal(planes["bmode"][:, INTERFACE + 1 :], whole["bmode"][:, INTERFACE + 1 :])


@pytest.mark.parametrize(("bright_lines", "mirrors"), [(3, False), (6, True)])
def test_lines_that_go_all_the_way_round_have_no_outermost_one(bright_lines, mirrors):
    turned = []
    for first in (0, 50, 97):
        planes = tissue(interface=0.2)
        bright = (first + np.arange(bright_lines)) % GHOST_SIDE
        planes["echo"][:, INTERFACE, bright] = planes["bmode"][:, INTERFACE, bright] = 0.95
        planes["echo"][:, TARGET] = planes["bmode"][:, TARGET] = 0.5
        add_ghosts(planes, RadialProbe(near_mm=0.0, far_mm=50.0), 0.5)
        turned.append(planes["bmode"].roll(-first, dims=2))
    assert torch.equal(turned[0], turned[1])
    assert torch.equal(turned[0], turned[2])
    assert bool((turned[0][0, 2 * INTERFACE - TARGET] > 0.2).any()) is mirrors


def test_a_needle_has_a_ghost_below_bone_and_the_frame_without_ghosts_is_as_it_was(random_scene):
    scene = random_scene(1, centre_cm=(0.0, 0.0, -500.0))
    plate = Needle(tip_mm=(30.0, 0.0, 25.0), hub_mm=(-30.0, 0.0, 25.0), diameter_mm=0.5, reverberation=0.0)
    above = Needle(tip_mm=(5.0, 0.0, 15.0), hub_mm=(-5.0, 0.0, 15.0), brightness=0.5, opacity=0.0, reverberation=0.0)
    asked = {"height": GHOST_SIDE, "width": GHOST_SIDE, "outputs": ("bmode",), "tools": (plate, above)}
    plain = render(scene, SQUARE, np.eye(4), **asked)["bmode"][0, :, GHOST_SIDE // 2]
    ghosts = render(scene, SQUARE, np.eye(4), **asked, ghost=0.5)["bmode"][0, :, GHOST_SIDE // 2]
    depths = SQUARE.depths_mm(GHOST_SIDE)
    assert depths[60 + ghosts[60:].argmax()] == pytest.approx(35.0, abs=0.8)  # the rows of a surface are two
    assert plain[60:].max() < 1e-6
    assert ghosts[60:].max() == pytest.approx(0.25, abs=0.02)
    without = render(scene, SQUARE, np.eye(4), **asked, ghost=0.0)["bmode"][0, :, GHOST_SIDE // 2]
    assert torch.equal(without, plain)
