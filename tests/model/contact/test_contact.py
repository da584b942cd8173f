"""Frames without contact and under pressure: the same on each backend, and those of the words of the documentation."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, LinearProbe, render
from ultragray.errors import InvalidArgument
from ultragray.rendering.backends import cpu
from ultragray.rendering.contact import MOST_COMPRESSION, at_rest
from ultragray.rendering.outputs import PLANES
from ultragray.rendering.settings import Contact

PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
SIZE = {"height": 48, "width": 40}
OUTPUTS = (*PLANES, "attenuation")


@pytest.fixture(scope="module")
def scene(random_scene):
    made = random_scene(400, info={"probe": PROBE})
    return replace(made, training_poses=np.stack([at(y=y) for y in np.linspace(-8.0, 8.0, 9)]))


def at(x=0.0, y=0.0, z=0.0, tilt_deg=0.0):  # [4, 4]
    """Upright on the skin z = 0, turned about the elevation."""
    angle, pose = np.radians(tilt_deg), np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0.0, -np.sin(angle)], [0.0, 1.0, 0.0], [np.sin(angle), 0.0, np.cos(angle)]]
    pose[:3, 3] = x, y, z
    return pose


def test_frames_in_contact_are_those_of_assumed_contact(scene):
    poses = scene.training_poses
    assumed = render(scene, None, poses, **SIZE, outputs=OUTPUTS)
    assert assumed.touch is None
    for contact in Contact:
        judged = render(scene, None, poses, **SIZE, outputs=OUTPUTS, contact=contact)
        assert judged.touch.shares.tolist() == [1.0] * len(poses)
        assert judged.touch.pressed_mm.tolist() == [0.0] * len(poses)
        for name in OUTPUTS:
            assert torch.equal(judged[name], assumed[name]), name


def test_scan_lines_in_the_air_are_dark_and_the_others_as_they_were(scene):
    poses = np.stack([at(tilt_deg=15.0), at(z=-5.0), at()])
    assumed = render(scene, None, poses, **SIZE, outputs=OUTPUTS)
    judged = render(scene, None, poses, **SIZE, outputs=OUTPUTS, contact=Contact.AIR)
    share, *others = judged.touch.shares
    assert 0.3 < share < 0.8
    assert others == [0.0, 1.0]
    touching = torch.from_numpy(judged.touch.lines)[:, None].expand(-1, SIZE["height"], -1)
    for name in ("bmode", "transmittance"):
        assert (judged[name][~touching] == 0).all()
        assert torch.equal(judged[name][touching], assumed[name][touching])
    assert assumed["bmode"][~touching].max() > 0.1
    for name in ("echo", "coverage"):  # of the tissue, whether the beam gets there or not
        assert torch.equal(judged[name], assumed[name])
    in_air = judged["attenuation"][1]  # all of the beam ends at the face
    assert (in_air[0] == 1.0).all()
    assert (in_air[1:] == 0.0).all()


@pytest.mark.parametrize("contact", Contact)
def test_backends_agree(scene, contact, assert_agrees):
    poses = np.stack([at(tilt_deg=10.0), at(z=2.5), at(z=-0.5), at(x=4.0, z=5.0, tilt_deg=-6.0)])
    reference = render(scene.to(torch.float64), None, poses, **SIZE, contact=contact, backend="reference")
    for backend in ("reference", *(["cpu"] if cpu.supports(scene) else [])):
        fast = render(scene, None, poses, **SIZE, contact=contact, backend=backend)
        assert_agrees(fast, {name: reference[name].numpy() for name in PLANES}, tolerance=5e-4)


@pytest.mark.parametrize(
    "probe",
    [PROBE, LinearProbe(30.0, 4.0, 40.0), ConvexProbe(opening_angle_deg=50.0, near_mm=20.0, far_mm=60.0)],
    ids=str,
)
def test_a_sample_shows_what_lay_where_the_documentation_says(probe):
    pressed, height = 6.0, 50
    longer, motion = at_rest(probe, pressed)
    length = probe.far_mm - probe.face_depth_mm
    depth = probe.depths_mm(height) - probe.face_depth_mm
    seen = longer.depths_mm(height) - longer.face_depth_mm + motion[2, 3]
    np.testing.assert_allclose(seen, depth - pressed * (1.0 - depth / length), atol=1e-9)
    np.testing.assert_allclose(motion[:3, :3], np.eye(3))


def test_pressure_brings_tissue_nearer_and_leaves_the_far_end(scene):
    pressed = render(scene, None, at(z=5.0), **SIZE, contact=Contact.PRESSURE)
    assert pressed.touch.pressed_mm[0] == pytest.approx(5.0, abs=1e-2)
    longer = LinearProbe(PROBE.width_mm, 0.0, 45.0)
    expected = render(scene, longer, at(), **SIZE)
    for name in PLANES:
        torch.testing.assert_close(pressed[name], expected[name], atol=2e-3, rtol=0.0)
    through = render(scene, None, at(z=5.0), **SIZE, contact=Contact.AIR)
    assert (through["bmode"] - pressed["bmode"]).abs().mean() > 0.01


def test_poses_keep_their_order_under_pressure(scene):
    poses = np.stack([at(z=3.0), at(y=4.0), at(x=3.0, z=6.0), at(z=-3.0)])
    together = render(scene, None, poses, **SIZE, contact=Contact.PRESSURE)
    for place, pose in enumerate(poses):
        alone = render(scene, None, pose, **SIZE, contact=Contact.PRESSURE)
        for name in PLANES:
            assert torch.equal(together[name][place], alone[name][0])


def test_compression_has_a_limit():
    longer, motion = at_rest(PROBE, 1000.0)
    assert longer.far_mm == pytest.approx(40.0 * (1.0 + MOST_COMPRESSION))
    assert motion[2, 3] == pytest.approx(-40.0 * MOST_COMPRESSION)


def test_gradients_reach_the_scene_and_the_pose(scene):
    pose = torch.from_numpy(at(z=4.0)[None]).requires_grad_()
    leaf = replace(scene, sh0=scene.sh0.clone().requires_grad_())
    frames = render(leaf, None, pose, **SIZE, outputs=("bmode",), contact=Contact.PRESSURE)
    frames["bmode"].sum().backward()
    assert float(pose.grad[0, :3, 3].norm()) > 0
    assert float(leaf.sh0.grad.norm()) > 0


def test_contact_is_also_known_by_its_word_and_others_are_refused(scene):
    for contact in Contact:
        by_word = render(scene, None, at(z=5.0), **SIZE, contact=contact.value)
        torch.testing.assert_close(by_word["bmode"], render(scene, None, at(z=5.0), **SIZE, contact=contact)["bmode"])
    for wrong in ("gel", True, 1):
        with pytest.raises(InvalidArgument, match=f"contact must be one of air, pressure, or None, got {wrong!r}"):
            render(scene, None, at(), **SIZE, contact=wrong)
