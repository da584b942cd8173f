"""Pictures of frames: what is where, in which proportions."""

import cv2
import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe, PhasedProbe
from ultragray.datasets import Sweep
from ultragray.learn.evaluation.scoring import evaluate, render_sweep
from ultragray.learn.evaluation.side_by_side import as_picture, side_by_side_panels, write_side_by_side

LINEAR = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=60.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=50.0)
PHASED = PhasedProbe(opening_angle_deg=60.0, far_mm=50.0)


def sweep_of(probe, poses):
    images = np.random.default_rng(0).integers(0, 200, (len(poses), 24, 20), dtype=np.uint8)
    return Sweep(images, poses, probe, np.arange(len(poses)) + 40, "made")


@pytest.mark.parametrize("probe", [LINEAR, CONVEX, PHASED], ids=["linear", "convex", "phased"])
def test_one_picture_a_frame(tmp_path, random_scene, random_poses, probe):
    scene, sweep = random_scene(80), sweep_of(probe, random_poses(3))
    paths = write_side_by_side(scene, sweep, evaluate(scene, sweep).frames, tmp_path / "new" / "pictures")
    assert [path.name for path in paths] == ["frame_00040.png", "frame_00041.png", "frame_00042.png"]
    height, width = as_picture(sweep.images[0] / 255.0, sweep).shape
    for place, path in enumerate(paths):
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert picture.shape == (height + 44, 5 * width + 24)
        truth = as_picture((sweep.images[place] / 255.0).astype(np.float32), sweep)
        np.testing.assert_array_equal(picture[22 : 22 + height, :width], truth)
        assert (picture[:22] < 128).any()
        assert (picture[-22:] < 128).any()


def test_panels(random_scene, random_poses):
    scene, sweep = random_scene(80), sweep_of(LINEAR, random_poses(2))
    truth, rendering, difference, echo, transmittance = side_by_side_panels(scene, sweep).values()
    np.testing.assert_allclose(difference, np.minimum(3 * np.abs(rendering - truth), 1.0), atol=1e-6)
    np.testing.assert_allclose(rendering, echo * transmittance, atol=1e-5)
    np.testing.assert_array_equal(rendering, render_sweep(scene, sweep))


def test_a_picture_has_square_pixels():
    frame = np.zeros((24, 20), np.float32)
    frame[:12] = 1.0
    tall = as_picture(frame, sweep_of(LINEAR, np.eye(4)[None]), 100)
    assert tall.shape == (100, 50)
    assert tall[:45].min() == 255
    assert tall[55:].max() == 0
    wide = as_picture(frame, sweep_of(LinearProbe(60.0, 0.0, 30.0), np.eye(4)[None]), 100)
    assert wide.shape == (50, 100)
