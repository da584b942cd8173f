"""Plans of batches, and the storages that their shards go to."""

import pytest

from ultragray.samplers import AroundSampler

from ...model.exchange import test_batches
from ...model.exchange.test_batches import scene_file
from ..storage.conftest import nothing_left_behind, storage

__all__ = ["nothing_left_behind", "scene_file", "storage"]


@pytest.fixture
def plan(scene_file):
    """110 frames in three shards."""
    return plan_of(scene_file, 110, 40)


def plan_of(scene_file, count, shard_frames):
    return test_batches.plan_of(scene_file, sampler=AroundSampler(count, seed=3), shard_frames=shard_frames)
