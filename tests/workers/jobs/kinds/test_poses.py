import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.errors import InvalidArgument, LowConfidence
from ultragray.samplers import AroundSampler, FanSampler, TrainingSampler
from ultragray.scene.confidence import Extrapolation
from ultragray_workers.jobs.kinds import RenderJob

PROBE = LinearProbe(40.0, 0.0, 50.0)
TRAINING = np.tile(np.eye(4), (2, 1, 1))
TRAINING[1, 0, 3] = 1000.0
GIVEN = (np.eye(4) + 7.0 * np.eye(4, k=3))[None]


def test_given_poses_and_training_poses_themselves():
    np.testing.assert_array_equal(RenderJob(scene="one", poses=GIVEN.tolist()).poses_of(TRAINING, PROBE), GIVEN)
    job = RenderJob(scene="one", sampler=TrainingSampler())
    np.testing.assert_array_equal(job.poses_of(TRAINING, PROBE), TRAINING)
    with pytest.raises(InvalidArgument, match="has none"):
        job.poses_of(TRAINING[:0], PROBE)


def test_a_sampler_makes_its_poses_of_given_ones_or_of_training_poses():
    sampler = AroundSampler(20, seed=3)
    around = RenderJob(scene="one", sampler=sampler).poses_of(TRAINING, PROBE)
    np.testing.assert_array_equal(around, sampler.poses(TRAINING, PROBE))
    fan = RenderJob(scene="one", poses=GIVEN.tolist(), sampler=FanSampler(5.0, 5.0)).poses_of(TRAINING[:0], PROBE)
    np.testing.assert_array_equal(fan[:, :3, 3], np.tile(GIVEN[:, :3, 3], (3, 1)))


def told(poses):  # [C, 4, 4] -> [C]
    """Sure of poses up to x = 10 mm."""
    return [Extrapolation(1.0, 2.0, 0.9 if pose[0, 3] <= 10 else 0.2, None) for pose in poses]


def test_given_poses_must_be_confident_and_samplers_keep_to_those_that_are():
    poses, extrapolations = RenderJob(scene="one", poses=TRAINING).assessed_poses(TRAINING, PROBE, told)
    np.testing.assert_array_equal(poses, TRAINING)
    assert [one.confidence for one in extrapolations] == [0.9, 0.2]
    with pytest.raises(LowConfidence, match=r"poses\[1\] .* 0\.20, 0\.5 is asked for: .* 1\.0 mm") as caught:
        RenderJob(scene="one", poses=TRAINING, min_confidence=0.5).assessed_poses(TRAINING, PROBE, told)
    assert caught.value.field == "poses[1]"
    sampled = RenderJob(scene="one", poses=TRAINING, sampler=AroundSampler(20), min_confidence=0.5)
    poses, extrapolations = sampled.assessed_poses(TRAINING[:0], PROBE, told)
    assert len(poses) == 20
    assert {one.confidence for one in extrapolations} == {0.9}
    with pytest.raises(InvalidArgument, match="has none"):
        RenderJob(scene="one", sampler=AroundSampler(20), min_confidence=0.5).assessed_poses(TRAINING[:0], PROBE, told)
