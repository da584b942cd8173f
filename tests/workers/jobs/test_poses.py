from __future__ import annotations

import numpy as np
import pytest

from ultragray.errors import InvalidArgument
from ultragray.pose import check_poses, position_distances_mm, rotation_angles_deg
from ultragray_workers.jobs.poses import jittered, poses_of
from ultragray_workers.jobs.specification import PoseSampler, RenderJob

TRAINING = np.tile(np.eye(4), (2, 1, 1))
TRAINING[1, 0, 3] = 1000.0


def test_jitter_has_the_spread_asked_for() -> None:
    poses = jittered(TRAINING[:1], PoseSampler("jitter", 4000, translation_mm=2.0, rotation_deg=5.0, seed=1))
    np.testing.assert_array_equal(check_poses(poses), poses)
    assert poses[:, :3, 3].std(axis=0) == pytest.approx([2.0] * 3, rel=0.05)
    angles = rotation_angles_deg(poses, TRAINING[:1])[:, 0]
    assert np.sqrt((angles**2).mean()) == pytest.approx(5.0, rel=0.05)


def test_jitter_lies_around_every_training_pose_and_repeats() -> None:
    sampler = PoseSampler("jitter", 50, translation_mm=1.0, seed=3)
    poses = jittered(TRAINING, sampler)
    nearest = position_distances_mm(poses, TRAINING).argmin(axis=1)
    assert set(nearest) == {0, 1}
    np.testing.assert_array_equal(poses, jittered(TRAINING, sampler))


def test_training_poses_themselves() -> None:
    job = RenderJob("one", sampler=PoseSampler("training"))
    np.testing.assert_array_equal(poses_of(job, TRAINING), TRAINING)
    with pytest.raises(InvalidArgument, match="has none"):
        poses_of(job, TRAINING[:0])
