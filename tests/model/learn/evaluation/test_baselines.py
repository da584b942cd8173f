"""Frames predicted from frames: the nearest, between two planes, and compounded volumes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe, PhasedProbe, RadialProbe, SteeredProbe
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.source import load_dataset
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.geometry.rotations import mean_axes
from ultragray.learn.evaluation import baselines as compounding
from ultragray.learn.evaluation.baselines import (
    BASELINES,
    affordable_voxel_mm,
    compound,
    evaluate_baselines,
    interpolate_planes,
    predict,
)
from ultragray.learn.prediction import blend_by_distance, seen_by_frame
from ultragray.learn.sweep import nearest_frames, pixel_positions_mm

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


def plainly_interpolated(sweep, pose, frames):
    """The definition of `interpolate_planes`, frame by frame, for one plane."""
    points = pixel_positions_mm(sweep.probe, sweep.height, sweep.width) @ pose[:3, :3].T + pose[:3, 3]
    distances, values = np.full((2, len(points)), np.inf), np.zeros((2, len(points)))
    for frame in frames:
        local = (points - sweep.poses[frame, :3, 3]) @ sweep.poses[frame, :3, :3]
        inside, seen = seen_by_frame(sweep, frame, local)
        for side, height in enumerate((local[inside, 1], -local[inside, 1])):
            nearer = (height >= 0) & (height < distances[side, inside])
            distances[side, np.flatnonzero(inside)[nearer]] = height[nearer]
            values[side, np.flatnonzero(inside)[nearer]] = seen[nearer]
    return np.nan_to_num(blend_by_distance(values, distances)).reshape(sweep.height, sweep.width) / 255.0


@pytest.mark.parametrize("probe", [LINEAR, CONVEX, PHASED, RADIAL, STEERED], ids=lambda probe: probe.kind)
def test_interpolation_is_that_of_its_definition(probe):
    """Frames cross each other, and show only parts of the planes."""
    rng, poses = np.random.default_rng(3), np.tile(np.eye(4), (14, 1, 1))
    axes, signs = np.linalg.qr(np.eye(3) + rng.normal(0.0, 0.15, (14, 3, 3)))
    poses[:, :3, :3] = axes * np.sign(np.diagonal(signs, axis1=1, axis2=2))[:, None]
    poses[:, :3, 3] = rng.normal(400.0, 1.5, (14, 3))
    sweep = replace(sweep_of(poses[:10], probe), images=rng.integers(0, 255, (10, 20, 16), np.uint8))
    every, some = np.tile(np.arange(10), (4, 1)), np.array([[3, 1, 7], [2, 9, -1], [5, -1, -1], [-1, -1, -1]])
    for asked, frames in ((None, every), (some, some)):
        found = interpolate_planes(sweep, poses[10:], asked)
        expected = [
            plainly_interpolated(sweep, pose, among[among >= 0]) for pose, among in zip(poses[10:], frames, strict=True)
        ]
        assert np.mean(np.abs(found - expected) < 1e-4) > 0.995  # a pixel at the edge of a frame may be in or out


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


HEIGHT, WIDTH = 12, 10
VOXEL_PROBE = LinearProbe(width_mm=WIDTH * 0.5, near_mm=0.0, far_mm=HEIGHT * 0.5)  # a pixel is a voxel of 0.5 mm


def compounded(images, poses, probe=VOXEL_PROBE):
    return Sweep(images.astype(np.uint8), poses, probe, np.arange(len(images)), "made")


@pytest.fixture
def images():  # [4, H, W]
    return np.random.default_rng(0).integers(0, 256, (4, HEIGHT, WIDTH))


@pytest.mark.parametrize(("method", "expected"), [("median", np.median), ("mean", np.mean), ("maximum", np.max)])
def test_frames_of_one_plane_are_folded_pixel_by_pixel(images, random_poses, method, expected):
    pose = random_poses(1, seed=5)
    volume = compound(compounded(images, np.repeat(pose, 4, axis=0)), method, 0.5)
    plane = volume.reslice(VOXEL_PROBE, pose, HEIGHT, WIDTH)
    np.testing.assert_allclose(plane[0], expected(images, axis=0) / 255.0, atol=2e-5)


def test_the_median_of_an_even_number_lies_between_the_middle_two(images):
    images[:, 3, 3] = (10, 20, 40, 200)
    plane = compound(compounded(images, at(0, 0, 0, 0)), "median", 0.5).reslice(VOXEL_PROBE, at(0), HEIGHT, WIDTH)
    assert plane[0, 3, 3] == pytest.approx(30 / 255, abs=1e-5)


@pytest.mark.parametrize(
    ("method", "elevations_mm", "limit", "value"),
    [("median", (0, 0.3, 0.6, 2.0), "MAX_SAMPLES", 100), ("mean", (0, 1.5, 3.0, 5.5), "SLAB_VOXELS", 1)],
    ids=["sorting", "filling"],
)
def test_working_in_parts_gives_the_same_volume(images, monkeypatch, method, elevations_mm, limit, value):
    sweep = compounded(images, at(*elevations_mm))
    whole = compound(sweep, method, 0.5)
    monkeypatch.setattr(compounding, limit, value)
    assert compound(sweep, method, 0.5).values.equal(whole.values)


def test_a_gap_between_two_frames_is_filled_with_what_lies_on_either_side():
    ramp = np.linspace(20, 40, WIDTH).round()
    images = np.stack([np.tile(ramp, (HEIGHT, 1)), np.tile(ramp + 100, (HEIGHT, 1))])
    volume = compound(compounded(images, at(0.0, 2.0)), "median", 0.5)
    plane = volume.reslice(VOXEL_PROBE, at(0.0, 1.0, 2.0), HEIGHT, WIDTH) * 255.0
    np.testing.assert_allclose(plane[1], (images[0] + images[1]) / 2, atol=4.0)
    np.testing.assert_allclose(plane[[0, 2]], images, atol=1e-2)


def test_what_no_frame_comes_near_is_black(images):
    volume = compound(compounded(images, at(0, 0.5, 1.0, 1.5)), "median", 0.5)
    away = at(0.0, 0.0)
    away[:, 0, 3] = (WIDTH * 0.5 + 1.0, 50.0)
    planes = volume.reslice(VOXEL_PROBE, away, HEIGHT, WIDTH)
    assert not planes.any()
    assert volume.reslice(VOXEL_PROBE, at(0.7), HEIGHT, WIDTH).any()
    assert volume.reslice(VOXEL_PROBE, at(), HEIGHT, WIDTH).shape == (0, HEIGHT, WIDTH)


@pytest.mark.parametrize("count", [1, 3])
def test_a_probe_that_was_held_still_is_not_seen_from_afar(images, count):
    volume = compound(compounded(images[:1].repeat(count, axis=0), at(*[0.0] * count)), "median", 0.5)
    planes = volume.reslice(VOXEL_PROBE, at(-500.0, -1.0, 0.0, 1.0, 500.0), HEIGHT, WIDTH)
    np.testing.assert_allclose(planes[2], images[0] / 255.0, atol=2e-5)
    assert not planes[[0, 1, 3, 4]].any()


def test_voxels_too_small_are_refused_with_one_that_fits(images, monkeypatch):
    sweep = compounded(images, at(0, 1, 2, 3))
    monkeypatch.setattr(compounding, "MAX_VOXELS", 1000)
    fits_mm = affordable_voxel_mm(sweep, 0.1)
    with pytest.raises(InvalidArgument, match=rf"voxel_mm must be at least {fits_mm:g} for made, .*, got 0\.1"):
        compound(sweep, "median", 0.1)
    assert compound(sweep, "median", fits_mm).values.numel() <= 1000
    with pytest.raises(InvalidArgument, match="voxel_mm"):
        compound(sweep, "median", fits_mm - 0.01)
    assert affordable_voxel_mm(sweep, 2.0) == 2.0


def test_the_mean_of_poses_is_a_rotation(random_poses):
    poses = random_poses(9, seed=1, tilt_deg=60.0)
    axes = mean_axes(poses)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(mean_axes(poses[:1]), poses[0, :3, :3], atol=1e-12)


@pytest.mark.parametrize(
    "probe",
    [
        LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=20.0),
        ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=30.0),
        RadialProbe(near_mm=1.0, far_mm=10.0),
        SteeredProbe(width_mm=20.0, steering_deg=25.0, near_mm=0.0, far_mm=20.0),
    ],
    ids=lambda probe: probe.kind,
)
def test_a_smooth_volume_comes_back_whatever_the_probe(probe):
    size = (80, 100)
    points = pixel_positions_mm(probe, *size)

    def frames(poses):  # [C, H, W] in [0, 1]
        places = np.einsum("cij,pj->cpi", poses[:, :3, :3], points) + poses[:, None, :3, 3]
        return (0.5 + 0.15 * np.sin(places / (3.0, 4.0, 5.0)).sum(axis=2)).reshape(-1, *size)

    poses, between = at(*np.arange(0.0, 6.0, 0.5)), at(1.25, 3.25)
    images = np.rint(255 * frames(poses)).astype(np.uint8)
    sweep = Sweep(images, poses, probe, np.arange(len(poses)), "made")
    planes = compound(sweep, "mean").reslice(probe, between, *size)
    inside = planes > 0.0
    assert inside.mean() > 0.95
    assert np.abs(planes - frames(between))[inside].mean() < 0.01
