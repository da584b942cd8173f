"""Hardness: where the anatomy changes between frames it is high, where it does not it is low."""

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.learn.sweep import Sweep
from ultragray.learn.training.confidence import hardness_of_views

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=40.0)


def changing_sweep(count, side):
    """The same texture in the first half of the frames, another in each frame of the second."""
    rng = np.random.default_rng(1)
    coarse = rng.integers(0, 255, (count, 16, 16))
    coarse[: count // 2] = coarse[0]
    images = np.kron(coarse, np.ones((side // 16, side // 16))).astype(np.uint8)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = 1.5 * np.arange(count)
    return Sweep(images, poses, PROBE, np.arange(count), "test")


@pytest.mark.long
@pytest.mark.parametrize("side", [32, 128])
def test_hard_is_where_neighbours_do_not_tell(side):
    hardness = hardness_of_views(changing_sweep(24, side))
    assert hardness.shape == (24,)
    assert hardness[:9].max() < -1.0 < 1.0 < hardness[15:].min()


def test_two_frames_tell_nothing():
    assert hardness_of_views(changing_sweep(24, 32).select([0, 1])).tolist() == [0.0, 0.0]
