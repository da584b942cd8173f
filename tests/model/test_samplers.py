"""Samplers of poses, and what they leave out for want of confidence."""

import json

import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe
from ultragray.contract import from_dict, to_dict
from ultragray.errors import InvalidArgument, LowConfidence
from ultragray.geometry.pose import check_poses
from ultragray.geometry.rotations import rotation_angles_deg, rotations_of, turns_of
from ultragray.samplers import (
    AroundSampler,
    CoveredSampler,
    FanSampler,
    Sampler,
    SplineSampler,
    TrainingSampler,
    assessed_poses,
    confident_poses,
)
from ultragray.samplers.confident import assessed_part
from ultragray.samplers.sampler import BLOCK_POSES
from ultragray.scene.confidence import Extrapolation

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)


def turned(axis, angles_deg):  # [C] -> [C, 4, 4]
    angles = np.radians(np.atleast_1d(angles_deg))
    poses = np.tile(np.eye(4), (len(angles), 1, 1))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    poses[:, i, i] = poses[:, j, j] = np.cos(angles)
    poses[:, j, i], poses[:, i, j] = np.sin(angles), -np.sin(angles)
    return poses


def swept(count=9, length_mm=16.0):
    """A curved sweep that sways, [C, 4, 4]."""
    u = np.linspace(0.0, 1.0, count)
    poses = turned(0, 20.0 * u) @ turned(1, 5.0 * np.sin(6.0 * u))
    poses[:, 0, 3], poses[:, 1, 3] = 3.0 * np.sin(4.0 * u), length_mm * u
    return poses


@pytest.mark.parametrize(
    "sampler",
    [
        TrainingSampler(),
        AroundSampler(7, 1.0, 2.0, seed=3),
        SplineSampler(count=7),
        SplineSampler(spacing_mm=0.5),
        FanSampler(10.0, 2.5),
        CoveredSampler(7, seed=3),
    ],
)
def test_there_and_back_and_again(sampler):
    document = json.loads(json.dumps(to_dict(sampler, with_none=False)))
    assert from_dict(Sampler, document) == sampler
    poses = sampler.poses(swept(), PROBE)
    np.testing.assert_array_equal(check_poses(poses), poses)
    np.testing.assert_array_equal(from_dict(Sampler, document).poses(swept(), PROBE), poses)


def test_around_has_the_spread_asked_for():
    poses = AroundSampler(4000, translation_mm=2.0, rotation_deg=5.0, seed=1).poses(np.eye(4), PROBE)
    assert poses[:, :3, 3].std(axis=0) == pytest.approx([2.0] * 3, rel=0.05)
    angles = rotation_angles_deg(poses, np.eye(4)[None])[:, 0]
    assert np.sqrt((angles**2).mean()) == pytest.approx(5.0, rel=0.05)


def test_spline_goes_through_its_base_poses_and_does_not_break():
    base = swept(7)
    fine = SplineSampler(count=6001).poses(base, PROBE)
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(base[:, :3, 3], axis=0), axis=1))])
    hit = np.rint(at / at[-1] * 6000).astype(int)
    np.testing.assert_allclose(fine[hit], base, atol=2e-3)
    np.testing.assert_allclose(fine[[0, -1]], base[[0, -1]], atol=1e-12)
    step = at[-1] / 6000
    first = np.diff(fine[:, :3, 3], axis=0) / step
    second = np.diff(first, axis=0) / step
    assert np.abs(np.diff(first, axis=0)).max() < 1e-3
    assert np.abs(np.diff(second, axis=0)).max() < 1e-2 * np.abs(second).max()
    assert np.abs(second[[0, -1]]).max() < 0.01 * np.abs(second).max()


def test_spline_turns_at_even_speed_the_short_way():
    base = turned(2, [10.0, 350.0])
    base[1, 0, 3] = 8.0
    poses = SplineSampler(spacing_mm=2.0).poses(base, PROBE)
    np.testing.assert_allclose(poses[:, 0, 3], [0, 2, 4, 6, 8], atol=1e-12)
    np.testing.assert_allclose(poses[:, :3, :3], turned(2, [10, 5, 0, -5, -10])[:, :3, :3], atol=1e-12)
    for angle in (-179.9, -150.0, 150.0, 179.9):
        ends = np.stack([np.eye(4), turned(0, angle)[0] + np.eye(4, k=3) * 5])
        middle, end = SplineSampler(count=3).poses(ends, PROBE)[1:, :3, :3]
        np.testing.assert_allclose(middle, turned(0, angle / 2)[0, :3, :3], atol=1e-9)
        np.testing.assert_allclose(end, ends[1, :3, :3], atol=1e-9)


def test_spline_passes_over_repetitions_but_not_over_turns_on_the_spot():
    base = swept(4)
    twice = base[[0, 0, 1, 2, 2, 3]]
    sampler = SplineSampler(count=5)
    np.testing.assert_array_equal(sampler.poses(twice, PROBE), sampler.poses(base, PROBE))
    with pytest.raises(InvalidArgument, match="0 and 1 differ in orientation only"):
        sampler.poses(turned(0, [0.0, 5.0]), PROBE)
    with pytest.raises(InvalidArgument, match="two different"):
        sampler.poses(base[[0, 0]], PROBE)
    with pytest.raises(InvalidArgument, match="spacing_mm"):
        SplineSampler(spacing_mm=1e-9).poses(base, PROBE)


def test_fan_tilts_whole_sweeps_about_the_face():
    base = swept(3)
    poses = FanSampler(tilt_deg=5.0, step_deg=2.5).poses(base, PROBE)
    assert len(poses) == 15
    np.testing.assert_array_equal(poses[6:9], base)
    np.testing.assert_array_equal(poses[:, :3, 3], np.tile(base[:, :3, 3], (5, 1)))
    np.testing.assert_allclose(poses[:3, :3, 0], base[:, :3, 0], atol=1e-15)
    tilted = base @ turned(0, 5.0)[0]
    np.testing.assert_allclose(poses[12:], tilted, atol=1e-15)
    assert (base[0, :3, 1] @ tilted[0, :3, 2]) < 0  # towards −y

    fan = ConvexProbe(opening_angle_deg=60.0, near_mm=30.0, far_mm=90.0)
    poses = FanSampler(tilt_deg=5.0, step_deg=5.0).poses(base, fan)
    faces = poses @ np.array([0.0, 0.0, 30.0, 1.0])
    np.testing.assert_allclose(faces, np.tile(faces[3:6], (3, 1)), atol=1e-12)
    assert np.abs(poses[0, :3, 3] - base[0, :3, 3]).max() > 1.0


def test_fan_takes_no_step_beyond_its_tilt():
    poses = FanSampler(tilt_deg=5.0, step_deg=2.0).poses(np.eye(4), PROBE)
    np.testing.assert_allclose(np.degrees(np.arctan2(poses[:, 2, 1], poses[:, 2, 2])), [-4, -2, 0, 2, 4])
    with pytest.raises(InvalidArgument, match="step_deg") as caught:
        FanSampler(tilt_deg=10.0, step_deg=1e-9).poses(np.eye(4), PROBE)
    assert caught.value.field == "step_deg"


def test_covered_stays_between_neighbours_and_out_of_gaps():
    one = np.tile(np.eye(4), (5, 1, 1))
    one[:, 1, 3] = np.arange(5)
    other = one.copy()
    other[:, 1, 3] += 100.0
    base = np.concatenate([one, other])[np.random.default_rng(0).permutation(10)]
    y = CoveredSampler(4000, seed=1).poses(base, PROBE)[:, 1, 3]
    inside = ((y > -1) & (y < 5)) | ((y > 99) & (y < 105))
    assert inside.all()
    assert (y < 50).mean() == pytest.approx(0.5, abs=0.03)
    share = np.histogram(y[y < 50], bins=4, range=(0, 4))[0] / (y < 50).sum()
    np.testing.assert_allclose(share, [0.203, 0.25, 0.25, 0.203], atol=0.02)  # the ends lose 3/64 to their outside


def test_more_poses_than_can_be_made_at_once_are_refused_in_words():
    with pytest.raises(InvalidArgument, match=r"100,001 is more than the 100,000 poses .* in shards") as caught:
        AroundSampler(100_001).poses(np.eye(4), PROBE)
    assert caught.value.field == "count"


@pytest.mark.parametrize("sampler", [AroundSampler(BLOCK_POSES * 2 + 7, seed=3), CoveredSampler(BLOCK_POSES + 7)])
@pytest.mark.parametrize("limit", [None, 0.5])
def test_any_part_of_drawn_poses_is_made_alone(sampler, limit):
    def assess(poses):
        return [Extrapolation(None, None, float(pose[0, 3] > 0.0), None) for pose in poses]

    whole, found = assessed_poses(sampler, swept(), PROBE, assess, limit)
    assert len(whole) == len(np.unique(whole[:, :3, 3], axis=0)) == sampler.count
    for first, last in [(0, 10), (4990, 5003), (BLOCK_POSES, sampler.count), (sampler.count - 1, sampler.count)]:
        part, told = assessed_part(sampler, swept(), PROBE, assess, limit, first, last)
        np.testing.assert_array_equal(part, whole[first:last])
        assert list(told) == list(found[first:last])


def test_any_part_of_other_poses_has_the_numbers_of_the_whole():
    def assess(poses):
        return [Extrapolation(1.0, 1.0, 0.5, None) for _ in poses]

    sampler = SplineSampler(count=30)
    part, _ = assessed_part(sampler, swept(), PROBE, assess, None, 20, 25)
    np.testing.assert_array_equal(part, sampler.poses(swept(), PROBE)[20:25])
    with pytest.raises(InvalidArgument, match="needs a sampler that draws"):
        assessed_part(sampler, swept(), PROBE, assess, 0.2, 20, 25)
    with pytest.raises(LowConfidence, match=r"poses\[3\] has"):
        assessed_part(None, swept(), PROBE, assess, 0.9, 3, 5)


def test_covered_turns_no_further_than_its_neighbours():
    base = turned(0, [0.0, 2.0, 4.0])
    poses = CoveredSampler(500, seed=1).poses(base, PROBE)
    np.testing.assert_array_equal(poses[:, :3, 3], 0.0)
    nearest = rotation_angles_deg(poses, base).min(axis=1)
    assert 1.0 < nearest.max() <= 3.0
    np.testing.assert_array_less(rotation_angles_deg(poses, base).max(axis=1), 6.0 + 1e-9)


@pytest.mark.parametrize(
    ("document", "field", "told"),
    [
        (3, None, "an object"),
        ({}, "kind", "one of around, covered"),
        ({"kind": "training", "count": 3}, "count", "takes nothing"),
        ({"kind": "around", "count": 100_000_001}, "count", "100000000"),
        ({"kind": "spline", "count": 100_001}, "count", "100000"),
        ({"kind": "around", "count": 1, "translation_mm": -1}, "translation_mm", "from 0 to 1000"),
        ({"kind": "around", "count": 1, "tilt_deg": 3}, "tilt_deg", "takes count, translation_mm"),
        ({"kind": "spline", "count": 3, "spacing_mm": 1.0}, "count", "exactly one"),
        ({"kind": "fan", "tilt_deg": 91, "step_deg": 1}, "tilt_deg", "90"),
    ],
)
def test_mistakes_name_the_field(document, field, told):
    with pytest.raises(InvalidArgument, match=told) as caught:
        from_dict(Sampler, document)
    assert caught.value.field == field


@pytest.mark.parametrize("kind", Sampler.members)
def test_no_base_poses(kind):
    numbers = {"around": {"count": 1}, "spline": {"count": 1}, "covered": {"count": 1}}
    numbers["fan"] = {"tilt_deg": 1, "step_deg": 1}
    with pytest.raises(InvalidArgument, match="needs base poses"):
        from_dict(Sampler, {"kind": kind, **numbers.get(kind, {})}).poses(np.zeros((0, 4, 4)), PROBE)


def test_turns_come_back_from_their_rotations():
    turns = np.random.default_rng(0).normal(0.0, 0.8, (50, 3))
    turns[0] = 0.0
    np.testing.assert_allclose(turns_of(rotations_of(turns)), turns, atol=1e-12)


SHORT_PROBE = LinearProbe(40.0, 0.0, 50.0)
BASE = np.tile(np.eye(4), (20, 1, 1))
BASE[:, 1, 3] = np.arange(20)


def assess(poses):  # [C, 4, 4] -> [C]
    """The confidence falls from 1 at y = 0 to 0 at y = 20."""
    return [Extrapolation(0.0, 0.0, float(np.clip(1 - pose[1, 3] / 20, 0, 1)), None) for pose in poses]


def confidences(told):
    return [one.confidence or 0.0 for one in told]


@pytest.mark.parametrize("sampler", [AroundSampler(300, seed=5), CoveredSampler(300, seed=5), AroundSampler(1, seed=1)])
@pytest.mark.parametrize("limit", [0.3, 0.9])
def test_random_samplers_draw_on_until_they_have_their_count(sampler, limit):
    poses, told = confident_poses(sampler, BASE, SHORT_PROBE, assess, limit)
    assert len(poses) == len(told) == sampler.count
    assert min(confidences(told)) >= limit
    np.testing.assert_allclose(confidences(told), confidences(assess(poses)))
    assert len(np.unique(poses[:, :3, 3], axis=0)) == sampler.count
    again, _ = confident_poses(sampler, BASE, SHORT_PROBE, assess, limit)
    np.testing.assert_array_equal(poses, again)


def test_those_drawn_first_come_first():
    sampler = AroundSampler(100, seed=9)
    first = sampler.poses(BASE, SHORT_PROBE)
    kept = first[np.array(confidences(assess(first))) >= 0.5]
    poses, _ = confident_poses(sampler, BASE, SHORT_PROBE, assess, 0.5)
    assert 0 < len(kept) < 100
    np.testing.assert_array_equal(poses[: len(kept)], kept)


@pytest.mark.parametrize("sampler", [TrainingSampler(), SplineSampler(count=39)])
def test_the_others_leave_poses_out(sampler):
    poses, told = confident_poses(sampler, BASE, SHORT_PROBE, assess, 0.5)
    made = sampler.poses(BASE, SHORT_PROBE)
    np.testing.assert_array_equal(poses, made[made[:, 1, 3] <= 10])
    assert 0.5 <= min(confidences(told)) < max(confidences(told)) == 1.0


def test_none_left():
    with pytest.raises(LowConfidence, match=r"makes 3 poses, none .* at least 0\.9: the best has 0\.25") as caught:
        confident_poses(TrainingSampler(), BASE[[15, 16, 17]], SHORT_PROBE, assess, 0.9)
    assert caught.value.field == "sampler"


@pytest.mark.parametrize(("count", "drawn"), [(3, 1000), (100, 2000)])
def test_a_search_that_finds_too_few_ends_and_says_what_it_found(count, drawn):
    looked_at = 0

    def few(poses):
        nonlocal looked_at
        looked_at += len(poses)
        sure = looked_at == count  # the first round only
        return [Extrapolation(None, None, 1.0 if sure and place == 0 else None, None) for place in range(len(poses))]

    sampler = AroundSampler(count)
    with pytest.raises(LowConfidence, match=f"found 1 of {count} poses .* of {drawn:,} drawn"):
        confident_poses(sampler, BASE, SHORT_PROBE, few, 0.9)
    assert looked_at == drawn
