"""Frames extrapolated from one side: farther away is worse where anatomy changes, and no worse where it does not."""

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.learn.sweep import Sweep
from ultragray.learn.training.confidence import BEYOND_MM, one_sided_examples
from ultragray.scene.confidence import DISTANCE_MM

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=40.0)
STEP_MM = 1.0
FRAMES = 18


def drifting_sweep(count, columns_per_frame):
    """Parallel frames of one texture that shifts sideways from each to the next."""
    texture = np.kron(np.random.default_rng(1).integers(0, 255, (8, 60)), np.ones((8, 4), int)).astype(np.uint8)
    images = np.stack([np.roll(texture, columns_per_frame * frame, axis=1)[:, :64] for frame in range(count)])
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = STEP_MM * np.arange(count)
    return Sweep(images, poses, PROBE, np.arange(count), "test")


def test_each_frame_is_predicted_from_either_side_and_ever_farther_away():
    examples = one_sided_examples(drifting_sweep(FRAMES, 1), np.zeros(FRAMES))
    distances = -examples.terms[:, 0, 2] * DISTANCE_MM
    assert sorted(set(distances.round(3))) == [1.0, 2.0, 4.0, 6.0, 9.0, 13.0]  # one step beyond each of BEYOND_MM
    assert len(BEYOND_MM) == 6
    nearest_frames = 2 * (FRAMES - 2)  # with at least two frames on that side
    assert (distances.round(3) == 1.0).sum() == nearest_frames


def test_scores_fall_with_distance_where_anatomy_changes_and_only_there():
    for columns_per_frame, falls in ((1, True), (0, False)):
        examples = one_sided_examples(drifting_sweep(FRAMES, columns_per_frame), np.zeros(FRAMES))
        distances = -examples.terms[:, 0, 2] * DISTANCE_MM
        near, far = (examples.ms_ssim[chosen].mean() for chosen in (distances < 1.5, distances > 8.0))
        assert (near - far > 0.2) if falls else (near == pytest.approx(far, abs=1e-6))


def test_two_frames_are_no_examples():
    examples = one_sided_examples(drifting_sweep(2, 1), np.zeros(2))
    assert len(examples.ms_ssim) == len(examples.terms) == 0
