"""Contact with the skin under training views: air, pressure, and frames of both on each backend."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, LinearProbe, PhasedProbe, RadialProbe, SteeredProbe, render
from ultragray.errors import InvalidArgument
from ultragray.rendering.confidence import supported_shares
from ultragray.rendering.contact import COUPLING_MM, MARGIN_MM, Skin, Touch
from ultragray.rendering.frames import render_grey
from ultragray.rendering.outputs import PLANES
from ultragray.rendering.pixels import to_uint8
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
        assert not judged.touch.depths_mm.any()
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


def test_frames_in_bytes_at_once_are_as_dark_in_the_air(scene):
    poses = np.stack([at(tilt_deg=15.0), at(z=-5.0), at()])
    judged = render(scene, None, poses, **SIZE, outputs=("bmode", "coverage"), contact=Contact.AIR)
    grey = render_grey(scene, None, poses, **SIZE, touch=judged.touch)
    assert np.array_equal(grey.bmode.numpy(), to_uint8(judged["bmode"].numpy()))
    assert np.array_equal(grey.supported, supported_shares(judged["coverage"]).numpy())


def test_poses_keep_their_order_under_pressure(scene):
    poses = np.stack([at(z=3.0), at(y=4.0), at(x=3.0, z=6.0), at(z=-3.0)])
    together = render(scene, None, poses, **SIZE, contact=Contact.PRESSURE)
    for place, pose in enumerate(poses):
        alone = render(scene, None, pose, **SIZE, contact=Contact.PRESSURE)
        for name in PLANES:
            assert torch.equal(together[name][place], alone[name][0])
        assert together.pressing.force_n[place] == alone.pressing.force_n[0]


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


WIDTH = 32
PROBES = [
    LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0),
    LinearProbe(width_mm=40.0, near_mm=3.0, far_mm=50.0),
    SteeredProbe(width_mm=40.0, steering_deg=15.0, near_mm=0.0, far_mm=50.0),
    ConvexProbe(opening_angle_deg=60.0, near_mm=40.0, far_mm=90.0),
    PhasedProbe(opening_angle_deg=80.0, far_mm=60.0),
]


def placed(probe, x=0.0, y=0.0, lifted_mm=0.0):  # [4, 4]
    """Upright, the middle of the face over (x, y) of the plane z = 0, which is the skin."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, -probe.face_depth_mm - lifted_mm
    return pose


def swept(probe):  # [21, 4, 4]
    return np.stack([placed(probe, y=y) for y in np.linspace(0.0, 40.0, 21)])


@pytest.mark.parametrize("probe", PROBES, ids=str)
def test_training_views_have_contact_and_are_not_pressed(probe):
    rng = np.random.default_rng(0)
    views = swept(probe)
    views[:, 2, 3] += rng.uniform(-2.0, 2.0, len(views))  # one was pressed harder than the other
    touch = Touch.of(Skin.under(views, probe), probe, views, WIDTH)
    assert touch.shares.min() > 0.95
    assert touch.mean(touch.depths_mm).max() < 0.3


@pytest.mark.parametrize("probe", PROBES, ids=str)
def test_a_lifted_probe_loses_contact_where_the_gap_is_more_than_the_gel(probe):
    skin = Skin.under(swept(probe), probe)
    for lifted_mm, share in ((0.8 * COUPLING_MM, 1.0), (1.3 * COUPLING_MM, 0.0), (30.0, 0.0)):
        touch = Touch.of(skin, probe, placed(probe, y=20.0, lifted_mm=lifted_mm), WIDTH)
        if probe.lines.unit == "deg":  # the outer lines of a fan run farther to the skin
            middle = touch.gaps_mm[0, WIDTH // 2 - 1 : WIDTH // 2 + 1]
            np.testing.assert_allclose(middle, lifted_mm, atol=0.1 + 0.02 * lifted_mm)
            assert touch.shares[0] <= share
        else:
            length = lifted_mm / probe.lines.rays(np.zeros(1))[1][0, 1]
            np.testing.assert_allclose(touch.gaps_mm, length, atol=1e-3)
            assert touch.shares[0] == share


def test_the_gap_is_measured_along_the_scan_line():
    probe = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
    angle = np.radians(10.0)
    pose = placed(probe, y=20.0)
    pose[:3, :3] = [[np.cos(angle), 0.0, -np.sin(angle)], [0.0, 1.0, 0.0], [np.sin(angle), 0.0, np.cos(angle)]]
    touch = Touch.of(Skin.under(swept(probe), probe), probe, pose, WIDTH)
    x = probe.lines.across(WIDTH)
    np.testing.assert_allclose(touch.gaps_mm[0], -x * np.tan(angle), atol=1e-3)
    assert touch.lines[0].tolist() == (-x * np.tan(angle) <= COUPLING_MM).tolist()


def test_a_round_skin_is_followed():
    """Views around a limb of 60 mm radius, 80° of it."""
    probe, radius = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=40.0), 60.0
    views = []
    for angle in np.radians(np.linspace(-40.0, 40.0, 41)):
        pose = np.eye(4)
        pose[:3, 2] = 0.0, -np.sin(angle), -np.cos(angle)
        pose[:3, 1] = 0.0, np.cos(angle), -np.sin(angle)
        pose[:3, 0] = np.cross(pose[:3, 1], pose[:3, 2])
        pose[:3, 3] = 0.0, radius * np.sin(angle), radius * np.cos(angle)
        views.append(pose)
    skin = Skin.under(np.stack(views), probe)
    between = 0.5 * (views[10] + views[11])
    between[:3, :3] = views[10][:3, :3]
    assert Touch.of(skin, probe, between, WIDTH).shares[0] == 1.0
    between[:3, 3] *= (radius + 4.0) / np.linalg.norm(between[:3, 3])
    off = Touch.of(skin, probe, between, WIDTH)
    np.testing.assert_allclose(off.gaps_mm, 4.0, atol=0.3)
    assert off.shares[0] == 0.0


def test_beyond_its_margin_no_skin_is_known():
    probe = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=50.0)
    skin = Skin.under(swept(probe), probe)
    inside, outside = (placed(probe, y=40.0 + MARGIN_MM + off) for off in (-1.5, 1.5))
    assert Touch.of(skin, probe, inside, WIDTH).shares[0] == 1.0
    assert np.isinf(Touch.of(skin, probe, outside, WIDTH).gaps_mm).all()
    assert np.isinf(Touch.of(skin, probe, placed(probe, x=500.0), WIDTH).gaps_mm).all()


def test_a_probe_that_looks_away_has_no_contact():
    probe = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=50.0)
    away = placed(probe, y=20.0) @ np.diag([1.0, -1.0, -1.0, 1.0])
    touch = Touch.of(Skin.under(swept(probe), probe), probe, away, WIDTH)
    assert touch.shares[0] == 0.0


def test_pressure_is_what_goes_beyond_the_innermost_face():
    probe = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=50.0)
    views = np.concatenate([swept(probe), swept(probe)])
    views[21:, 2, 3] = 2.0  # the second pass was pressed by 2 mm
    skin = Skin.under(views, probe)
    poses = np.stack([placed(probe, y=20.0, lifted_mm=-pressed) for pressed in (0.0, 2.0, 5.0)])
    touch = Touch.of(skin, probe, poses, WIDTH)
    np.testing.assert_allclose(touch.mean(touch.depths_mm), [0.0, 0.0, 3.0], atol=1e-2)


@pytest.mark.parametrize(
    ("poses", "probe", "match"),
    [
        (np.zeros((0, 4, 4)), PROBES[0], "knows its training poses"),
        (np.eye(4)[None], None, "knows its training poses"),
        (np.eye(4)[None], RadialProbe(near_mm=1.0, far_mm=20.0), "all around"),
        (np.stack([np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0])]), PROBES[0], "all around"),
    ],
)
def test_no_skin_where_there_is_no_surface(poses, probe, match):
    with pytest.raises(InvalidArgument, match=match) as error:
        Skin.under(poses, probe)
    assert error.value.field == "contact"
