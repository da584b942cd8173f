"""Tissue that gives way to a face and to needles, beside finite elements of layers."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, LinearProbe, _cpu, render
from ultragray.errors import InvalidArgument
from ultragray.rendering.settings import Contact, FrameSettings
from ultragray.rendering.tools import Needle

from ..scripts import benchmark

pytest.importorskip("skfem")
elastic = benchmark("pressing")
FAT_MUSCLE = {8.0: 1, 150.0: 2}
FAT_MUSCLE_BONE = {8.0: 1, 23.0: 2, 150.0: 3}
SIZE = {"height": 64, "width": 48, "outputs": ("bmode",)}


@pytest.fixture(scope="module")
def layered():
    return elastic.layered_scene(FAT_MUSCLE_BONE)


def at(z=0.0, tilt_deg=0.0):  # [4, 4]
    """The face `z` mm below the skin, turned about the elevation."""
    angle, pose = np.radians(tilt_deg), np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0.0, -np.sin(angle)], [0.0, 1.0, 0.0], [np.sin(angle), 0.0, np.cos(angle)]]
    pose[2, 3] = z
    return pose


@pytest.mark.parametrize("layers", [FAT_MUSCLE, FAT_MUSCLE_BONE], ids=["deep", "on bone"])
def test_tissue_under_the_face_moves_as_finite_elements_do(layers):
    found = elastic.beside_finite_elements(layers)
    assert found["worst"] < 0.1
    assert found["rms"] < 0.06
    assert found["worst_lateral"] < 0.1
    assert found["force_n"] == pytest.approx(found["true_force_n"], rel=0.2)


def test_an_interface_is_seen_where_finite_elements_have_it():
    seen, true = elastic.interface_depths(FAT_MUSCLE, 4.0)
    assert seen == pytest.approx(true, abs=0.4)
    assert elastic.INTERFACE_MM - 4.0 + 1.0 < seen < elastic.INTERFACE_MM - 1.0


def test_bone_stays_and_what_lies_on_it_keeps_its_place(layered):
    frames = elastic.pressed(layered, 4.0)
    points = np.array([(x, y, z) for x in (-18.0, 0.0, 26.0) for y in (-5.0, 0.0) for z in (30.0, 45.0)])
    assert np.abs(elastic.displaced_mm(frames, points)).max() < 0.05
    above = elastic.displaced_mm(frames, np.array([(0.0, 0.0, 2.0)]))
    assert above[0, 2] > 2.5


def test_tissue_goes_aside_and_does_not_turn_inside_out(layered):
    frames = elastic.pressed(layered, 12.0)
    points = np.random.default_rng(0).uniform((-35.0, -12.0, 0.0), (35.0, 12.0, 40.0), (2000, 3))
    _, gradient = frames.pressing.displacement.at(torch.from_numpy(points))
    assert torch.linalg.det(torch.eye(3) + gradient).min() > 0.05
    beside = elastic.displaced_mm(frames, np.array([(24.0, 0.0, 8.0), (-24.0, 0.0, 8.0), (0.0, 9.0, 8.0)]))
    assert beside[0, 0] > 0.5
    assert beside[1, 0] == pytest.approx(-beside[0, 0], rel=0.05)
    assert beside[2, 1] > 0.5


def test_force_grows_with_depth_and_with_stiffness(layered):
    forces = [elastic.pressed(layered, depth).pressing.force_n[0] for depth in (1.0, 2.0, 4.0)]
    assert forces[0] > 0.2
    assert forces[1] == pytest.approx(2 * forces[0], rel=0.1)
    assert forces[2] > 1.8 * forces[1]
    stiff = replace(layered, info=replace(layered.info, label_names={1: "muscle", 2: "tendon", 3: "bone"}))
    assert elastic.pressed(stiff, 1.0).pressing.force_n[0] > 2 * forces[0]


def test_only_the_side_that_is_pressed_in_presses(layered):
    tilted = render(layered, None, at(z=1.0, tilt_deg=6.0), **SIZE, contact=Contact.PRESSURE)
    depths = tilted.touch.depths_mm[0]
    assert depths[0] == 0.0 or depths[-1] == 0.0
    side = 1.0 if depths[-1] > depths[0] else -1.0
    pressed, lifted = elastic.displaced_mm(tilted, np.array([(15.0 * side, 0.0, 4.0), (-15.0 * side, 0.0, 4.0)]))
    assert pressed[2] > 1.0
    assert abs(lifted[2]) < 0.3 * pressed[2]


def test_a_curved_face_presses_along_its_lines(layered):
    probe = ConvexProbe(opening_angle_deg=50.0, near_mm=40.0, far_mm=100.0)
    scene = replace(layered, info=replace(layered.info, probe=probe), training_poses=layered.training_poses.copy())
    scene.training_poses[:, 2, 3] = -40.0
    frames = render(scene, None, at(z=-37.0), **SIZE, contact=Contact.PRESSURE)
    assert frames.pressing.indentation_mm[0] == pytest.approx(3.0, abs=0.1)
    angle = np.radians(15.0)
    out = np.array([np.sin(angle), 0.0, np.cos(angle)])
    middle, aside = elastic.displaced_mm(frames, np.array([(0.0, 0.0, 1.0), 41.0 * out - (0.0, 0.0, 40.0)]))
    assert middle[2] == pytest.approx(2.8, abs=0.4)
    assert aside @ out == pytest.approx(2.8, abs=0.6)


def test_depth_may_be_told_and_needs_pressure(layered):
    told = render(layered, None, at(), **SIZE, contact=Contact.PRESSURE, indentation_mm=3.0)
    assert told.pressing.indentation_mm.tolist() == [3.0]
    by_pose = render(layered, None, at(z=3.0), **SIZE, contact=Contact.PRESSURE)
    assert told.pressing.force_n[0] == pytest.approx(by_pose.pressing.force_n[0], rel=0.15)
    with pytest.raises(InvalidArgument, match="needs contact pressure, got contact air") as error:
        FrameSettings(contact=Contact.AIR, indentation_mm=3.0)
    assert error.value.field == "indentation_mm"
    with pytest.raises(InvalidArgument, match="needs contact pressure"):
        render(layered, None, at(), **SIZE, indentation_mm=3.0)


def test_nothing_moves_where_the_face_is_not_pressed_in(layered):
    poses = np.stack([at(), at(z=-4.0)])
    air, pressure = (render(layered, None, poses, **SIZE, contact=contact) for contact in Contact)
    assert pressure.pressing.displacement is None
    assert not pressure.pressing.force_n.any()
    assert torch.equal(air["bmode"], pressure["bmode"])


def test_a_needle_draws_tissue_along_its_shaft(layered):
    needle = Needle(tip_mm=(8.0, 0.0, 16.0), hub_mm=(-20.0, 0.0, -4.0))
    frames = render(layered, None, at(), **SIZE, tools=(needle,), contact=Contact.PRESSURE)
    along = np.array([28.0, 0.0, 20.0]) / np.hypot(28.0, 20.0)
    on, beside, far = elastic.displaced_mm(frames, np.array([(-2.0, 0.0, 9.0), (-2.0, 9.0, 9.0), (-2.0, 12.0, 19.0)]))
    assert 0.3 < on @ along < 3.0
    assert on @ along > 2 * (beside @ along) > 2 * (far @ along) > 0.0
    assert frames.pressing.force_n[0] == 0.0


def test_gradients_by_poses_are_those_of_a_field_that_stays():
    scene = elastic.layered_scene(FAT_MUSCLE, count=4000)
    weights = torch.rand((1, 64, 48), generator=torch.Generator().manual_seed(0))

    def gradient(scene, contact):
        pose = torch.from_numpy(at(z=4.0)[None]).requires_grad_()
        frames = render(scene, None, pose, **{**SIZE, "outputs": ("echo",)}, contact=contact)
        (frames["echo"] * weights).sum().backward()
        return pose.grad, frames

    pressed, frames = gradient(scene, Contact.PRESSURE)
    still, _ = gradient(scene.under(frames.pressing.displacement), None)
    assert float(still[0, :3, 3].abs().min()) > 0.1
    torch.testing.assert_close(pressed, still, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "kpa"),
    [("Liver", 5.5), ("left kidney", 5.0), ("vertebrae_L3", np.inf), ("Ribs", np.inf), ("fibroid", 10.0), ("", 10.0)],
)
def test_stiffness_follows_the_words_of_a_label(name, kpa):
    assert _cpu.stiffness_kpa(name) == kpa


def test_a_scene_without_labels_gives_way_as_soft_tissue(random_scene):
    plain = random_scene(400, info={"probe": LinearProbe(30.0, 0.0, 40.0)})
    scene = replace(plain, training_poses=np.stack([at(), at()]))
    frames = render(scene, None, at(z=3.0), **SIZE, contact=Contact.PRESSURE)
    assert 0.5 < frames.pressing.force_n[0] < 3.0
