"""The phantom: its tissues, how its images form, the poses that it is scanned from, and the shadow of its bones."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe
from ultragray.datasets import Sweep
from ultragray.errors import DatasetInvalid, InvalidArgument, InvalidPose
from ultragray.geometry.pose import check_poses
from ultragray.phantom import (
    PHANTOM_PROBE,
    Tissue,
    anatomy,
    bone_attenuation_db,
    freehand_poses,
    imaging,
    load_phantom,
    simulate,
    sweeps,
    tissue_at,
    tissues,
)
from ultragray.phantom.anatomy import ACOUSTICS, FREQUENCY_MHZ, INTERFACES, LatticeNoise
from ultragray.phantom.imaging import NOTHING, PER_MM3, ScattererField, Scatterers
from ultragray.phantom.recipes import SHEETS_DB, spine_recipe
from ultragray.scene.tissues import reflection_db

from ..scripts import benchmark


@pytest.mark.parametrize(
    ("tissue", "point_mm"),
    [
        (Tissue.OUTSIDE, (0.0, 0.0, -0.5)),
        (Tissue.SKIN, (5.0, 0.0, 1.0)),
        (Tissue.FAT, (14.0, 0.0, 5.0)),
        (Tissue.MUSCLE, (-14.0, 0.0, 22.0)),
        (Tissue.BONE, (0.0, 4.0, 20.0)),  # spinous process
        (Tissue.BONE, (9.0, 2.0, 35.0)),  # lamina
        (Tissue.LIGAMENT, (0.0, 18.0, 25.0)),  # between two spinous processes
        (Tissue.BLOOD, (21.0, 0.0, 23.0)),
        (Tissue.FLUID, (0.0, 18.0, 47.0)),  # dural sac
        (Tissue.FAT, (0.0, 18.0, 39.5)),  # epidural
        (Tissue.DISC, (0.0, 17.5, 60.0)),
        (Tissue.BONE, (0.0, 0.0, 60.0)),  # vertebral body
    ],
)
def test_tissue_at_landmarks(tissue, point_mm):
    assert tissue_at(np.array([point_mm]))[0] == tissue


def test_fascia_is_a_thin_layer_between_fat_and_muscle():
    depth = np.arange(5.0, 15.0, 0.02)
    line = np.stack([np.full_like(depth, 14.0), np.zeros_like(depth), depth], axis=1)
    labels = tissue_at(line)
    assert list(dict.fromkeys(labels.tolist())) == [Tissue.FAT, Tissue.FASCIA, Tissue.MUSCLE]
    assert 0.7 < 0.02 * (labels == Tissue.FASCIA).sum() < 1.4


def test_tissue_at_keeps_to_uint8_and_refuses_other_shapes():
    assert tissue_at(np.zeros((0, 3))).dtype == np.uint8
    for shape in ((3,), (2, 4), (1, 2, 3)):
        with pytest.raises(InvalidArgument, match="points_mm must be"):
            tissue_at(np.zeros(shape))


def test_the_skin_is_flat_under_the_probe():
    points = np.random.default_rng(0).uniform((-30, -40, 0), (30, 40, 0), (200, 3))
    np.testing.assert_array_equal(anatomy.straightened(points), points)


def test_bone_distance_never_promises_more_than_there_is():
    rng = np.random.default_rng(2)
    points = rng.uniform((-30, -15, 10), (30, 15, 65), (4000, 3))
    steps = rng.normal(size=points.shape)
    steps *= 0.01 / np.linalg.norm(steps, axis=1, keepdims=True)
    slope = np.abs(anatomy.distance_mm(points + steps) - anatomy.distance_mm(points)) / 0.01
    assert slope.max() < 1.15
    assert (slope > 0.5).mean() > 0.3


def test_every_interface_is_met_somewhere_and_carries_a_sign_change():
    points = np.random.default_rng(3).uniform((-30, -18, 0), (30, 18, 62), (60_000, 3)).astype(np.float32)
    drawn = anatomy.straightened(points)
    for interface in INTERFACES:
        low, high = interface.depths_mm
        inside = (points[:, 2] > low) & (points[:, 2] < high)
        here = drawn[inside]
        here = here[interface.present(here)]
        level = interface.level(here)
        assert 0.0 < (level < 0.0).mean() < 1.0
        assert (np.abs(level) < 0.4).sum() > 20


def test_noise_is_smooth_seeded_and_of_its_own_scale():
    noise = LatticeNoise(5, (2.0, 10.0, 1.0))
    points = np.random.default_rng(4).uniform(-50, 50, (20_000, 3))
    values = noise(points)
    assert np.abs(values).max() <= 1.0
    assert values.std() > 0.2
    np.testing.assert_array_equal(LatticeNoise(5, (2.0, 10.0, 1.0))(points), values)
    assert np.abs(np.corrcoef(LatticeNoise(6, (2.0, 10.0, 1.0))(points), values)[0, 1]) < 0.1
    change = [np.abs(noise(points + 0.01 * axis) - values).max() / 0.01 for axis in np.eye(3)]
    assert change[1] < 0.4  # at most 3 per cell: 2 (the range) × 1.5 (the smoothest step)
    assert change[0] < 1.6
    assert change[1] < change[0] < change[2] < 3.1


BoneShadow = benchmark("bone_shadow").BoneShadow
PROBE = LinearProbe(width_mm=24.0, near_mm=0.0, far_mm=50.0)
HEIGHT, WIDTH = 214, 102  # about the phantom's own pixels
SIZE = {"probe": PROBE, "height": HEIGHT, "width": WIDTH}


def at(x=0.0, y=0.0, tilt_deg=0.0):
    """A pose on the skin, tilted about the lateral axis."""
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, c, -s], [0, s, c]]
    pose[:2, 3] = x, y
    return pose


WITHIN_A_TISSUE = (1, 3, 6, 7, 8, 9, 13)  # of INTERFACES, those whose two sides are the same tissue
SPINE, BESIDE, NEXT, FURTHER, TILTED = range(5)


@pytest.fixture(scope="module")
def frames():  # [5, H, W]
    poses = [at(), at(20.0), at(20.0, 0.3), at(20.0, 3.5), at(20.0, 0.0, 25.0)]
    return simulate(np.stack(poses), **SIZE)


def rows(low_mm, high_mm):
    return slice(round(low_mm * HEIGHT / 50.0), round(high_mm * HEIGHT / 50.0))


def columns(low_mm, high_mm):
    return slice(round((low_mm + 12.0) * WIDTH / 24.0), round((high_mm + 12.0) * WIDTH / 24.0))


def test_bone_is_the_brightest_and_its_shadow_black(frames):
    frame = frames[SPINE]
    crest = frame[rows(12.5, 16.0), columns(-2.0, 2.0)].max(axis=0)
    assert np.median(crest) > 200
    lamina = frame[rows(27.0, 36.0), columns(5.0, 11.0)]
    assert np.median(lamina.max(axis=0)) > 200
    assert frame[rows(42.0, 50.0), columns(-10.0, 10.0)].max() <= 2


def test_the_vessel_is_dark_within_muscle(frames):
    depth, lateral = np.meshgrid(PROBE.depths_mm(HEIGHT), PROBE.scan_lines(WIDTH)[0][:, 0], indexing="ij")
    points = np.stack([lateral + 20.0, np.zeros_like(depth), depth], axis=-1).reshape(-1, 3)
    labels = tissue_at(points).reshape(HEIGHT, WIDTH)
    distance = anatomy.vessel_distance_mm(anatomy.straightened(points)).reshape(HEIGHT, WIDTH)
    muscle = frames[BESIDE][labels == Tissue.MUSCLE].mean()
    assert 50 < muscle < 120
    assert frames[BESIDE][distance < -1.5].mean() < 0.1 * muscle


def test_interfaces_fade_when_the_beam_leaves_their_normal(frames):
    straight, tilted = (
        np.median(frames[which][rows(7.5, 11.5), columns(-8.0, 8.0)].max(axis=0)) for which in (BESIDE, TILTED)
    )
    assert straight > tilted + 40


def test_speckle_is_shared_by_neighbours_and_lost_with_distance(frames):
    muscle = (rows(12.0, 19.0), columns(-10.0, 10.0))
    here, near, far = (frames[which][muscle].ravel().astype(float) for which in (BESIDE, NEXT, FURTHER))
    assert np.corrcoef(here, near)[0, 1] > 0.9
    assert np.corrcoef(here, far)[0, 1] < 0.75


def test_a_frame_does_not_depend_on_its_company(frames):
    np.testing.assert_array_equal(simulate(at(20.0, 3.5), **SIZE)[0], frames[FURTHER])


def test_speckle_has_the_statistics_of_three_independent_looks(monkeypatch):
    """Rayleigh envelopes: the mean of K independent powers has a standard deviation of 1/√K of its mean."""
    rng = np.random.default_rng(0)
    grid = imaging.Grid.of(PROBE, HEIGHT, WIDTH)
    cells = grid.cell_mm[0] * grid.cell_mm[1]
    thickness = np.sqrt(np.pi) * imaging.anatomy.elevation_sigma_mm(grid.depths_mm)[:, None]  # of a weight squared
    looks = []
    for _ in range(3):
        noise = rng.normal(size=grid.shape) + 1j * rng.normal(size=grid.shape)
        phasors = noise * np.sqrt(0.5 * PER_MM3 * cells * thickness)
        looks.append(np.abs(imaging._blurred(phasors.astype(np.complex64), grid)) ** 2)
    inside = np.mean(looks, axis=0)[40:-40, 20:-20]
    assert inside.mean() == pytest.approx(1.0, abs=0.06)
    assert inside.std() == pytest.approx(1.0 / np.sqrt(3.0), abs=0.06)
    upper, lower = np.array_split(inside, 2)
    assert upper.mean() == pytest.approx(lower.mean(), rel=0.15)


def test_the_recipe_of_the_spine_reflects_where_two_tissues_meet_as_the_phantom_does():
    acoustics = {body.label: body.acoustics for body in spine_recipe()[0].bodies}
    found = ScattererField().slice(np.eye(4), np.array([-30.0, -1.0, 0.0]), np.array([30.0, 1.0, 60.0]))
    above, below = (tissue_at(found.surface_mm + side * found.normals) for side in (-0.6, 0.6))
    compared = 0
    for first, second in itertools.combinations(acoustics, 2):
        here = (np.minimum(above, below) == first) & (np.maximum(above, below) == second)
        if here.sum() > 100:
            phantom_db = 20.0 * np.log10(np.median(found.specular[here]))
            made_db = reflection_db(acoustics[first].impedance, acoustics[second].impedance)
            assert made_db == pytest.approx(phantom_db, abs=2.0), (Tissue(first), Tissue(second))
            compared += 1
    assert compared > 6


def test_the_recipe_of_the_spine_is_as_bright_as_the_phantom_with_the_sheets_within_its_tissues():
    silent = {"specular_db": -99.0, "diffuse_db": -99.0}
    poses = freehand_poses(9, tilt_deg=5.0)[::4]
    labels = tissues(poses, **SIZE)
    bare, sheets = (
        simulate(
            poses,
            **SIZE,
            phantom=replace(
                anatomy.SPINE,
                interfaces=tuple(
                    one if number in kept else replace(one, **silent) for number, one in enumerate(INTERFACES)
                ),
            ),
        )
        for kept in ((), WITHIN_A_TISSUE)
    )
    for tissue, expected_db in SHEETS_DB.items():
        lit = (labels == tissue) & (bare > 0)
        raised_db = (sheets[lit].mean() - bare[lit].mean()) / 255.0 * imaging.DYNAMIC_RANGE_DB
        assert raised_db == pytest.approx(expected_db, abs=1.0), tissue


def test_bone_attenuation_starts_at_the_bone_and_only_grows():
    attenuation = bone_attenuation_db(at(), **SIZE)[0]
    assert attenuation.shape == (HEIGHT, WIDTH)
    assert (np.diff(attenuation, axis=0) >= -1e-3).all()
    depth = PROBE.depths_mm(HEIGHT)
    middle = attenuation[:, WIDTH // 2]
    fine = np.arange(10.0, 20.0, 0.01)
    points = np.stack([np.full_like(fine, 0.12), np.zeros_like(fine), fine], axis=1)
    first = fine[np.argmax(anatomy.distance_mm(anatomy.straightened(points)) < 0.0)]
    assert middle[depth < first - 0.3].max() == 0.0
    per_mm = 0.2 * FREQUENCY_MHZ * ACOUSTICS[Tissue.BONE].attenuation
    assert per_mm > 15.0
    assert np.interp(first + 2.0, depth, middle) == pytest.approx(2.0 * per_mm, abs=0.15 * per_mm)
    assert bone_attenuation_db(at(46.0), **SIZE).max() == 0.0


def test_two_slices_hold_the_same_scatterers_where_they_cross():
    field = ScattererField()
    low, high = np.array([-4.0, -1.0, 20.0]), np.array([4.0, 1.0, 28.0])
    one, other = (field.slice(pose, low, high) for pose in (at(20.0), at(20.0, 0.5)))
    shared = {tuple(p) for p in one.points_mm.tolist()} & {tuple(p) for p in other.points_mm.tolist()}
    assert len(shared) / len(one.points_mm) == pytest.approx(0.75, abs=0.03)
    again = ScattererField().slice(at(20.0), low, high)
    np.testing.assert_array_equal(again.points_mm, one.points_mm)
    np.testing.assert_array_equal(again.amplitudes, one.amplitudes)


def test_a_probe_that_looks_away_sees_nothing_and_a_mirror_is_refused():
    away = np.diag([1.0, -1.0, -1.0, 1.0])
    away[2, 3] = -5.0
    assert simulate(away, **SIZE).max() == 0
    assert simulate(np.zeros((0, 4, 4)), **SIZE).shape == (0, HEIGHT, WIDTH)
    for function in (simulate, bone_attenuation_db, tissues):
        with pytest.raises(InvalidPose):
            function(np.diag([-1.0, 1.0, 1.0, 1.0]), **SIZE)


class OneScatterer:
    """A field with a single scatterer before the image plane of the identity, in the focus."""

    def __init__(self, elevation_mm):
        self.place = np.array([[3.0, elevation_mm, 32.0]], dtype=np.float32)

    def slice(self, *_):
        return Scatterers.join([NOTHING, replace(NOTHING, points_mm=self.place, amplitudes=np.ones(1, np.float32))])


def test_a_point_shows_the_beam_and_the_pulse():
    grid = imaging.Grid.of(PROBE, HEIGHT, WIDTH)
    power = imaging._power(OneScatterer(0.0), grid, np.eye(4))
    row, column = np.unravel_index(power.argmax(), power.shape)
    assert PROBE.depths_mm(HEIGHT)[row] == pytest.approx(32.0, abs=0.15)
    assert PROBE.scan_lines(WIDTH)[0][column, 0] == pytest.approx(3.0, abs=0.15)
    across, down = power[row].sum() / power.max(), power[:, column].sum() / power.max()
    root_pi = np.sqrt(np.pi)  # ∫ exp(−x²/σ²) dx = √π σ
    assert across * 24.0 / WIDTH == pytest.approx(root_pi * 0.34, rel=0.05)
    assert down * 50.0 / HEIGHT == pytest.approx(root_pi * 0.17, rel=0.3)
    beside = imaging._power(OneScatterer(0.6), grid, np.eye(4))
    assert beside.max() / power.max() == pytest.approx(np.exp(-1.0), rel=0.01)


def test_tissues_are_those_in_the_middle_of_each_pixel():
    probe, height, width = LinearProbe(width_mm=24.0, near_mm=3.0, far_mm=50.0), 40, 21
    poses = np.stack([at(), at(20.0, 7.0, 25.0)])
    found = tissues(poses, probe=probe, height=height, width=width)
    assert found.shape == (2, height, width)
    z, x = np.meshgrid(
        3.0 + (np.arange(height) + 0.5) / height * 47.0, ((np.arange(width) + 0.5) / width - 0.5) * 24.0, indexing="ij"
    )
    middles = np.stack([x, np.zeros_like(x), z, np.ones_like(x)], axis=-1).reshape(-1, 4)
    for pose, labels in zip(poses, found, strict=True):
        expected = tissue_at((middles @ pose.T)[:, :3]).reshape(height, width)
        assert (labels != expected).mean() < 0.005  # rounding decides at a border
    assert {Tissue.BONE, Tissue.MUSCLE, Tissue.FAT} <= {Tissue(value) for value in np.unique(found)}


SQUARE_PROBE = LinearProbe(width_mm=60.0, near_mm=0.0, far_mm=60.0)
SIDE = 60  # a pixel a millimetre


def sweep_at(x_mm, probe=SQUARE_PROBE):
    """A frame over the middle vertebra and one between two, shifted along x, of nothing but noise."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 0, 3] = x_mm
    poses[1, 1, 3] = 19.0
    images = np.random.default_rng(0).integers(0, 256, (2, SIDE, SIDE), dtype=np.uint8)
    return Sweep(images, poses, probe, np.arange(2), "noise")


def test_it_lies_behind_the_laminae_and_not_beside_or_between_them():
    over, between = BoneShadow.of(sweep_at(0.0)).hidden
    assert over[40:, 20:40].all()
    assert not over[:12].any()
    assert not over[:, :6].any()
    assert not between[:52, 26:34].any()


def test_means_are_taken_over_the_shadow_alone():
    sweep = sweep_at(0.0)
    shadow = BoneShadow.of(sweep)
    inside = shadow.hidden.astype(np.float32)
    assert shadow.mean(inside) == 1.0
    assert shadow.mean(1.0 - inside) == 0.0
    truth = (sweep.images / 255.0).astype(np.float32)
    assert shadow.mean_absolute_error(truth + 1.0 - inside) == pytest.approx(0.0, abs=1e-7)
    assert shadow.mean_absolute_error(truth - 0.25 * inside) == pytest.approx(0.25, abs=1e-6)


def test_sweeps_that_cannot_tell_are_refused():
    with pytest.raises(DatasetInvalid, match="noise: no pixel lies in the shadow"):
        BoneShadow.of(sweep_at(90.0))
    with pytest.raises(DatasetInvalid, match="noise: the phantom is scanned along upright lines, got convex probe"):
        BoneShadow.of(sweep_at(0.0, ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=50.0)))


def tilts_deg(poses):
    """Angle of each beam from the depth axis along the spine."""
    return np.degrees(np.arctan2(-poses[:, 1, 2], poses[:, 2, 2]))


def test_the_straight_sweep_is_rigid_even_and_centred():
    poses = freehand_poses(91)
    np.testing.assert_allclose(check_poses(poses), poses, atol=1e-12)
    np.testing.assert_allclose(np.diff(poses[:, 1, 3]), 72.0 / 90, atol=1e-9)
    np.testing.assert_allclose(poses[45], np.eye(4), atol=1e-12)
    assert np.abs(tilts_deg(poses)).max() < 5.0


def test_tilt_and_offset_are_what_was_asked_for():
    poses = freehand_poses(61, tilt_deg=9.0, offset_mm=2.0)
    assert tilts_deg(poses).mean() == pytest.approx(9.0, abs=0.5)
    assert poses[:, 0, 3].mean() == pytest.approx(2.0, abs=0.1)
    swayed = freehand_poses(61, tilt_deg=9.0, offset_mm=2.0, unrest=1.0)
    assert np.abs(swayed - poses).max() > 0.5


def test_counts():
    assert [freehand_poses(count).shape for count in (0, 1, 8)] == [(0, 4, 4), (1, 4, 4), (8, 4, 4)]
    with pytest.raises(InvalidArgument, match="count"):
        freehand_poses(-1)


def test_load_phantom_holds_out_a_sweep_at_a_tilt_of_its_own(monkeypatch):
    def stamps(poses):
        return np.round(128 + poses[:, 1, 3])

    def stamped(poses, *, height, width, **_):
        frames = np.zeros((len(poses), height, width), dtype=np.uint8)
        frames[:, 0, 0] = stamps(poses)
        return frames

    monkeypatch.setattr(sweeps, "simulate", stamped)
    dataset = load_phantom()
    assert (dataset.name, dataset.probe) == ("phantom", PHANTOM_PROBE)
    assert (len(dataset.train), len(dataset.val)) == (211, 24)
    assert (dataset.train.height, dataset.train.width) == (256, 256)
    for part in (dataset.train, dataset.val):
        np.testing.assert_array_equal(part.images[:, 0, 0], stamps(part.poses))
    numbers = np.concatenate([dataset.train.frame_numbers, dataset.val.frame_numbers])
    np.testing.assert_array_equal(numbers, np.arange(235))
    parts = np.split(dataset.train.poses, [91, 151])
    tilts = [float(tilts_deg(part).mean()) for part in (*parts, dataset.val.poses)]
    np.testing.assert_allclose(tilts, [0.0, 9.0, -9.0, 5.0], atol=1.0)
    # no held-out plane is one of the training planes
    apart = np.abs(dataset.train.poses[:, None] - dataset.val.poses).max(axis=(2, 3))
    assert apart.min() > 0.05
