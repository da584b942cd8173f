"""What prints on a prompt is short: no arrays."""

import numpy as np
import torch

from ultragray import Frames, LinearProbe
from ultragray.datasets import Dataset, Sweep
from ultragray.scene.info import SceneHeader

PROBE = LinearProbe(40.0, 0.0, 50.0)
IN_WORDS = "linear probe (width 40 mm, near 0 mm, far 50 mm)"


def test_frames():
    planes = {name: torch.zeros(8, 512, 256) for name in ("bmode", "echo")}
    assert repr(Frames(planes)) == "Frames(8 of 512x256: bmode, echo)"
    assert repr(Frames({})) == "Frames(0 of 0x0: )"


def test_a_scene(random_scene):
    assert repr(random_scene(1200)) == "GaussianScene(1,200 Gaussians, no probe)"
    scene = random_scene(60, info={"probe": PROBE, "dataset_name": "liver"})
    assert repr(scene) == f"GaussianScene('liver', 60 Gaussians, {IN_WORDS})"
    header = repr(SceneHeader(scene.info, np.zeros((3, 4, 4)), 10, np.zeros((3, 4, 4))))
    assert header.endswith("file_bytes=10)")
    assert "array" not in header


def test_a_sweep():
    images = np.random.default_rng(0).integers(0, 250, (10, 20, 16), dtype=np.uint8)
    sweep = Sweep(images, np.tile(np.eye(4), (10, 1, 1)), PROBE, np.arange(10), "scan.mha")
    assert repr(sweep) == f"Sweep(10 frames of 20x16, {IN_WORDS}, 'scan.mha')"
    assert "array" not in repr(Dataset("liver", sweep, sweep.select([1])))
