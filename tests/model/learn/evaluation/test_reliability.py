"""Expected against actual errors: what holds is told, and so is what is too sure."""

import json
from dataclasses import replace

import numpy as np
import pytest

from ultragray import LinearProbe, render
from ultragray.datasets import Sweep
from ultragray.errors import DatasetInvalid
from ultragray.learn.evaluation.scoring import compare_deviations, measure_reliability
from ultragray.scene.confidence import DEPTHS, VARIANCE_TERMS, ConfidenceModel, DepthBands, Uncertainty

PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
POSES = np.tile(np.eye(4), (4, 1, 1))


def drawn(spread):
    """Deviations of 100,000 pixels, and normal errors that are `spread` times as large."""
    rng = np.random.default_rng(0)
    deviations = rng.choice([0.015, 0.05, 0.2], 100_000).astype(np.float32)
    return (spread * deviations * rng.normal(size=100_000)).astype(np.float32), deviations


def test_what_holds():
    found = compare_deviations(*drawn(1.0))
    assert (found.within_1, found.within_2) == pytest.approx((0.683, 0.954), abs=0.01)
    assert found.actual == pytest.approx(found.expected, rel=0.02)
    assert [one.expected for one in found.bins] == pytest.approx([0.015, 0.05, 0.2])
    assert [one.actual for one in found.bins] == pytest.approx([0.015, 0.05, 0.2], rel=0.03)
    assert sum(one.share for one in found.bins) == pytest.approx(1.0)
    json.dumps(found.to_dict(), allow_nan=False)


def test_what_is_too_sure():
    found = compare_deviations(*drawn(2.0))
    assert found.within_1 == pytest.approx(0.383, abs=0.01)
    assert found.actual == pytest.approx(2.0 * found.expected, rel=0.02)


def test_of_a_scene(random_scene):
    floor = tuple(0.4 if name == "floor" else 0.0 for name in VARIANCE_TERMS)  # a variance of 0.4 times 0.001
    confidence = ConfidenceModel(
        (3.5, 1.2, 0.8, 0.1, 0.6),
        0.06,
        (0.0,) * 4,
        20,
        0.04,
        uncertainty=Uncertainty(floor, DepthBands((0.3,) * DEPTHS, (0.1,) * DEPTHS)),
    )
    made = random_scene(100, info={"probe": PROBE, "confidence": confidence.to_dict()})
    scene = replace(made, training_poses=POSES)
    frames = render(scene, PROBE, POSES, height=32, width=32)["bmode"].numpy()
    noise = np.random.default_rng(0).normal(0.0, 0.02, frames.shape)
    images = (255.0 * np.clip(frames + noise, 0.0, 1.0)).round().astype(np.uint8)
    sweep = Sweep(images, POSES, PROBE, np.arange(4), "noisy")
    found = measure_reliability(scene, sweep)
    assert found.expected == pytest.approx(0.02, rel=1e-3)
    assert found.actual == pytest.approx(0.02, rel=0.3)  # black pixels lose half of it
    assert measure_reliability(random_scene(20), sweep) is None
    with pytest.raises(DatasetInvalid, match="no frames to measure with"):
        measure_reliability(scene, sweep.select([]))
