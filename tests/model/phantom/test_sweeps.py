"""The phantom as a dataset: which poses it is scanned from, and that these are the frames it holds."""

import numpy as np
import pytest

from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.phantom import PHANTOM_PROBE, freehand_poses, load_phantom, sweeps


def tilts_deg(poses):
    """Angle of each beam from the depth axis along the spine."""
    return np.degrees(np.arctan2(-poses[:, 1, 2], poses[:, 2, 2]))


def test_the_straight_sweep_is_rigid_even_and_centred():
    poses = freehand_poses(91)
    np.testing.assert_allclose(check_poses(poses), poses, atol=1e-12)
    np.testing.assert_allclose(np.diff(poses[:, 1, 3]), 72.0 / 90, atol=1e-9)
    np.testing.assert_allclose(poses[45], np.eye(4), atol=1e-12)
    assert np.abs(tilts_deg(poses)).max() < 5.0


def test_tilt_and_offset_are_what_was_asked_for():
    poses = freehand_poses(61, tilt_deg=9.0, offset_mm=2.0)
    assert tilts_deg(poses).mean() == pytest.approx(9.0, abs=0.5)
    assert poses[:, 0, 3].mean() == pytest.approx(2.0, abs=0.1)
    swayed = freehand_poses(61, tilt_deg=9.0, offset_mm=2.0, unrest=1.0)
    assert np.abs(swayed - poses).max() > 0.5


def test_counts():
    assert [freehand_poses(count).shape for count in (0, 1, 8)] == [(0, 4, 4), (1, 4, 4), (8, 4, 4)]
    with pytest.raises(InvalidArgument, match="count"):
        freehand_poses(-1)


def test_load_phantom_holds_out_a_sweep_at_a_tilt_of_its_own(monkeypatch):
    def numbered(poses, *, height, width, **_):
        frames = np.zeros((len(poses), height, width), dtype=np.uint8)
        frames[:, 0, 0] = 1 + np.arange(len(poses)) % 255
        return frames

    monkeypatch.setattr(sweeps, "simulate", numbered)
    dataset = load_phantom()
    assert (dataset.name, dataset.probe) == ("phantom", PHANTOM_PROBE)
    assert (len(dataset.train), len(dataset.val)) == (211, 24)
    assert (dataset.train.height, dataset.train.width) == (256, 256)
    together = np.concatenate([dataset.train.images[:, 0, 0], dataset.val.images[:, 0, 0]])
    np.testing.assert_array_equal(together, 1 + np.arange(235))
    parts = np.split(dataset.train.poses, [91, 151])
    tilts = [float(tilts_deg(part).mean()) for part in (*parts, dataset.val.poses)]
    np.testing.assert_allclose(tilts, [0.0, 9.0, -9.0, 5.0], atol=1.0)
    # no held-out plane is one of the training planes
    apart = np.abs(dataset.train.poses[:, None] - dataset.val.poses).max(axis=(2, 3))
    assert apart.min() > 0.05
