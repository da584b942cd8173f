"""The skin under training views, for every kind of probe, and the contact of poses with it."""

import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe, PhasedProbe, RadialProbe, SteeredProbe
from ultragray.errors import InvalidArgument
from ultragray.rendering.contact import COUPLING_MM, MARGIN_MM, Skin, Touch

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
    assert touch.pressed_mm.max() < 0.3


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
    pose[:3, :3] = [
        [np.cos(angle), 0.0, -np.sin(angle)],
        [0.0, 1.0, 0.0],
        [np.sin(angle), 0.0, np.cos(angle)],
    ]
    touch = Touch.of(Skin.under(swept(probe), probe), probe, pose, WIDTH)
    x = probe.lines.across(WIDTH)
    np.testing.assert_allclose(touch.gaps_mm[0], -x * np.tan(angle), atol=1e-3)
    assert touch.lines[0].tolist() == (-x * np.tan(angle) <= COUPLING_MM).tolist()


def test_it_does_not_matter_how_the_sweep_lies_in_space():
    probe = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
    motion = np.eye(4)
    motion[:3, :3] = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    motion[:3, :3] *= np.sign(np.linalg.det(motion[:3, :3]))
    motion[:3, 3] = 300.0, -200.0, 50.0
    poses = np.stack([placed(probe, 3.0, 11.0, lifted) for lifted in (-2.0, 0.0, 3.0)])
    here = Touch.of(Skin.under(swept(probe), probe), probe, poses, WIDTH)
    there = Touch.of(Skin.under(motion @ swept(probe), probe), probe, motion @ poses, WIDTH)
    np.testing.assert_allclose(there.gaps_mm, here.gaps_mm, atol=1e-2)


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


def test_a_curved_face_on_flat_skin_touches_in_the_middle():
    flat = LinearProbe(width_mm=60.0, near_mm=0.0, far_mm=50.0)
    convex = ConvexProbe(opening_angle_deg=60.0, near_mm=40.0, far_mm=90.0)
    touch = Touch.of(Skin.under(swept(flat), flat), convex, placed(convex, y=20.0), WIDTH)
    gaps = 40.0 * (1.0 / np.cos(np.radians(convex.lines.across(WIDTH))) - 1.0)
    np.testing.assert_allclose(touch.gaps_mm[0], gaps, atol=1e-2)
    assert 0.3 < touch.shares[0] < 0.7


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
    np.testing.assert_allclose(Touch.of(skin, probe, poses, WIDTH).pressed_mm, [0.0, 0.0, 3.0], atol=1e-2)


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
