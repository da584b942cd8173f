import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.errors import LowConfidence
from ultragray.samplers import (
    AroundSampler,
    CoveredSampler,
    FanSampler,
    SplineSampler,
    TrainingSampler,
    confident_poses,
)
from ultragray.scene.confidence import Extrapolation

PROBE = LinearProbe(40.0, 0.0, 50.0)
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
    poses, told = confident_poses(sampler, BASE, PROBE, assess, limit)
    assert len(poses) == len(told) == sampler.count
    assert min(confidences(told)) >= limit
    np.testing.assert_allclose(confidences(told), confidences(assess(poses)))
    assert len(np.unique(poses[:, :3, 3], axis=0)) == sampler.count
    again, _ = confident_poses(sampler, BASE, PROBE, assess, limit)
    np.testing.assert_array_equal(poses, again)


@pytest.mark.parametrize("sampler", [AroundSampler(50, seed=3), CoveredSampler(50, seed=3), FanSampler(5.0, 5.0)])
def test_poses_that_all_will_do_are_the_samplers_own(sampler):
    poses, _ = confident_poses(sampler, BASE, PROBE, assess, 0.0)
    np.testing.assert_array_equal(poses, sampler.poses(BASE, PROBE))


def test_those_drawn_first_come_first():
    sampler = AroundSampler(100, seed=9)
    first = sampler.poses(BASE, PROBE)
    kept = first[np.array(confidences(assess(first))) >= 0.5]
    poses, _ = confident_poses(sampler, BASE, PROBE, assess, 0.5)
    assert 0 < len(kept) < 100
    np.testing.assert_array_equal(poses[: len(kept)], kept)


@pytest.mark.parametrize("sampler", [TrainingSampler(), SplineSampler(count=39)])
def test_the_others_leave_poses_out(sampler):
    poses, told = confident_poses(sampler, BASE, PROBE, assess, 0.5)
    made = sampler.poses(BASE, PROBE)
    np.testing.assert_array_equal(poses, made[made[:, 1, 3] <= 10])
    assert 0.5 <= min(confidences(told)) < max(confidences(told)) == 1.0


def test_none_left():
    with pytest.raises(LowConfidence, match=r"makes 3 poses, none .* at least 0\.9: the best has 0\.25") as caught:
        confident_poses(TrainingSampler(), BASE[[15, 16, 17]], PROBE, assess, 0.9)
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
        confident_poses(sampler, BASE, PROBE, few, 0.9)
    assert looked_at == drawn
