import numpy as np
import pytest

from ultragray import GaussianScene, LinearProbe
from ultragray.exchange.batches import BatchPlan
from ultragray.files import file_sha256
from ultragray.rendering.settings import FrameSettings
from ultragray.samplers import AroundSampler
from ultragray.scene.info import read_header
from ultragray_workers.storage.location import open_storage

PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
TRAINING = np.tile(np.eye(4), (6, 1, 1))
TRAINING[:, 1, 3] = np.arange(6)


@pytest.fixture
def scene_file(tmp_path, random_scene):
    made = random_scene(60, info={"probe": PROBE, "image_height": 24, "image_width": 20})
    path = tmp_path / "one.ugr"
    GaussianScene.from_splats(made.splats, info=made.info, training_poses=TRAINING).save(path)
    return path


@pytest.fixture
def plan(scene_file):
    """110 frames in three shards."""
    return plan_of(scene_file, 110, 40)


@pytest.fixture
def nothing_left_behind():
    """Instead of the one for pools: there are none here, and obstore keeps its connections."""


@pytest.fixture(params=["folder", pytest.param("bucket", marks=pytest.mark.slow)])
def storage(request, tmp_path):
    """An empty storage: a folder, or a bucket of a real S3 server."""
    if request.param == "folder":
        return open_storage(tmp_path / "storage")
    return open_storage(request.getfixturevalue("new_bucket")(), patience_s=5)


def plan_of(scene_file, count, shard_frames):
    return BatchPlan.prepared(
        read_header(scene_file),
        FrameSettings(),
        sampler=AroundSampler(count, seed=3),
        poses=None,
        shard_frames=shard_frames,
        scene="one",
        scene_sha256=file_sha256(scene_file),
    )
