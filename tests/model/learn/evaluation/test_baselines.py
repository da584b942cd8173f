"""Frames predicted from frames: the nearest, and what lies between two planes."""

import math

import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe, PhasedProbe, RadialProbe, SteeredProbe
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.source import load_dataset
from ultragray.errors import DatasetInvalid
from ultragray.learn.evaluation.baselines import BASELINES, evaluate_baselines, interpolate_planes, predict
from ultragray.learn.sweep import nearest_frames

LINEAR = LinearProbe(width_mm=8.0, near_mm=0.0, far_mm=10.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=8.0, far_mm=20.0)
PHASED = PhasedProbe(opening_angle_deg=80.0, far_mm=20.0)
RADIAL = RadialProbe(near_mm=1.0, far_mm=8.0)
STEERED = SteeredProbe(width_mm=8.0, steering_deg=20.0, near_mm=0.0, far_mm=10.0)


def at(*elevations_mm, tilt_deg=0.0):
    poses = np.tile(np.eye(4), (len(elevations_mm), 1, 1))
    poses[:, 1, 3] = elevations_mm
    c, s = math.cos(math.radians(tilt_deg)), math.sin(math.radians(tilt_deg))
    poses[:, 1:3, 1:3] = [[c, -s], [s, c]]
    return poses


def sweep_of(poses, probe=LINEAR, *, height=20, width=16):
    """Frame f is noise plus 20·f."""
    noise = np.random.default_rng(0).integers(0, 20, (height, width))
    images = (noise + 20 * np.arange(len(poses))[:, None, None]).astype(np.uint8)
    return Sweep(images, poses, probe, np.arange(len(poses)), "made")


@pytest.mark.parametrize("probe", [LINEAR, CONVEX, PHASED, RADIAL, STEERED], ids=lambda probe: probe.kind)
def test_between_two_planes_the_distance_decides(probe):
    sweep = sweep_of(at(0.0, 1.0, 4.0), probe)
    images = sweep.images / 255.0
    planes = interpolate_planes(sweep, at(0.0, 0.25, 1.0, 3.0))
    np.testing.assert_allclose(planes[0], images[0], atol=1e-6)
    np.testing.assert_allclose(planes[1], 0.75 * images[0] + 0.25 * images[1], atol=1e-6)
    np.testing.assert_allclose(planes[2], images[1], atol=1e-6)
    np.testing.assert_allclose(planes[3], (images[1] + 2 * images[2]) / 3, atol=1e-6)


def test_beyond_the_last_plane_it_is_taken_as_it_is():
    sweep = sweep_of(at(0.0, 1.0))
    np.testing.assert_allclose(interpolate_planes(sweep, at(5.0))[0], sweep.images[1] / 255.0, atol=1e-6)


def test_where_no_frame_reaches_it_is_black():
    poses = at(0.5)
    poses[:, 0, 3] = LINEAR.width_mm / 2
    plane = interpolate_planes(sweep_of(at(0.0, 1.0)), poses)[0]
    assert not plane[:, 8:].any()
    np.testing.assert_allclose(plane[:, :8], sweep_of(at(0.0, 1.0)).images[:, :, 8:].mean(axis=0) / 255.0, atol=1e-6)


def test_nearest_looks_at_the_whole_plane_not_only_its_origin():
    upright, tilted = at(0.0), at(0.2, tilt_deg=30.0)
    sweep = sweep_of(np.concatenate([upright, tilted]))
    asked = at(0.3)  # nearer to the origin of the tilted one
    assert nearest_frames(sweep, asked).tolist() == [0]
    np.testing.assert_array_equal(predict(sweep, asked, "nearest")[0], (sweep.images[0] / 255.0).astype(np.float32))


def test_baselines_are_measured_on_the_held_out_frames():
    sweep = sweep_of(at(0.0, 1.0, 2.0))
    dataset = Dataset("made", sweep.select([0, 2]), sweep.select([1]))
    found = evaluate_baselines(dataset)
    assert list(found) == list(BASELINES)
    assert found["linear"].mean.psnr_db > 90.0
    assert found["nearest"].mean.psnr_db == pytest.approx(20 * math.log10(255 / 20), abs=1e-4)
    with pytest.raises(DatasetInvalid, match="no frames to measure with"):
        evaluate_baselines(Dataset("made", sweep, sweep.select([])))


def test_the_nearest_frame_of_a_real_sweep_gives_the_published_figures(data_folder):
    mean = evaluate_baselines(load_dataset(data_folder / "spine_phantom"), ("nearest",))["nearest"].mean
    assert mean.psnr_db == pytest.approx(21.00, abs=0.005)
    assert [mean.ms_ssim, mean.gms, mean.gmsd] == pytest.approx([0.816, 0.907, 0.155], abs=0.0006)
