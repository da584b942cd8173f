"""Classical methods beside the curve of a training."""

import json

import pytest

from ultragray.learn.training.agreement import with_shares
from ultragray_workers.jobs.kinds.train_run import write_baselines

from ....model.learn.training.test_agreement import FRAMES, PROBE, hand_path, recording


@pytest.fixture
def following():
    """Tissue that goes along with the probe: poses as tracked predict no frame."""
    tracked = hand_path()
    return recording(with_shares(tracked, [range(FRAMES)], PROBE, (0.0,) * 3), tracked)


def test_classical_methods_predict_by_the_poses_that_the_training_is_measured_by(following, tmp_path):
    found = {}
    for mode in ("none", "path"):
        write_baselines(following, tmp_path / f"{mode}.json", lambda: False, mode)
        found[mode] = json.loads((tmp_path / f"{mode}.json").read_text())
    assert found["path"]["linear"] > found["none"]["linear"] + 1.0
    assert found["path"]["in-time"] == found["none"]["in-time"]
