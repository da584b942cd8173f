"""Where the Gaussians begin, the lengths that training follows, its batches, and the evidence for shadows."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, LinearProbe, SceneInfo
from ultragray.learn.sweep import Sweep
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.between import neighbours_of
from ultragray.learn.training.geometry import (
    BatchSampler,
    Geometry,
    Shadows,
    frame_spacing_mm,
    out_of_plane_range_mm,
    out_of_plane_shift_mm,
    shared_detail,
    shift_out_of_plane,
)
from ultragray.learn.training.initial import DETAIL_MM, WIDER, initial_parameters
from ultragray.learn.training.intensity import least_sh0, project_sh0, sh0_of_intensity
from ultragray.learn.training.optimizer import rotate
from ultragray.rendering.backends import reference
from ultragray.scene.info import expected_shapes


def whole_start_of(dataset, config, **how):
    geometry, neighbours = Geometry.of(dataset), neighbours_of(dataset.train)
    shadows = Shadows(dataset.train) if config.transmittance else None
    generator = torch.Generator().manual_seed(3)
    return initial_parameters(dataset, neighbours, shadows, geometry, config.resolved(geometry), generator, **how)


def start_of(dataset, config):
    return whole_start_of(dataset, config).parameters


def test_informed_start_lies_on_pixels_of_that_brightness(tiny_dataset, tiny_config, probe):
    dataset = tiny_dataset(probe=probe, frames=9)
    images = np.repeat(dataset.train.images[:1], len(dataset.train), axis=0)  # so that y does not matter
    dataset = replace(dataset, train=replace(dataset.train, images=images))
    geometry = Geometry.of(dataset)
    parameters = start_of(dataset, tiny_config(max_gaussians=400, transmittance=False))
    points_mm = parameters["means"].double().numpy() * 10.0 + geometry.centre_mm
    x, y, z = (points_mm - dataset.train.poses[0, :3, 3]).T
    if probe.kind == "linear":
        across, depth = x / probe.width_mm + 0.5, z
    else:
        across = np.degrees(np.arctan2(x, z)) / probe.opening_angle_deg + 0.5
        depth = np.hypot(x, z)
    row = (depth - probe.near_mm) / probe.scan_line_length_mm * dataset.train.height
    column = across * dataset.train.width
    inside = (np.abs(row - np.round(row)) > 1e-3) & (np.abs(column - np.round(column)) > 1e-3)  # float32 means
    pixels = images[0, row.astype(int), column.astype(int)] / 255.0
    scene = GaussianScene.from_splats(parameters, info=SceneInfo(intensity="sigmoid"))
    intensity = reference.intensity(scene, torch.zeros(3)).double().numpy()
    assert inside.mean() > 0.95
    assert np.abs(intensity - pixels)[inside].max() < 1e-5
    planes = dataset.train.poses[:, 1, 3] - dataset.train.poses[0, 1, 3]
    extent_mm = neighbours_of(dataset.train).extent_mm
    assert planes.min() - extent_mm <= y.min() < planes.min()
    assert planes.max() < y.max() <= planes.max() + extent_mm
    shares, _ = np.histogram(y, planes)
    shares = shares / np.diff(planes)
    assert shares.min() > 0.6 * shares.mean(), "no gap stays empty"


def test_random_start_is_the_released_cube(tiny_dataset, tiny_config):
    dataset = tiny_dataset()
    half_side = 0.8 * Geometry.of(dataset).scene_scale_cm
    config = TrainingConfig.preset("paper", max_gaussians=8000)
    parameters = start_of(dataset, config)
    assert parameters["means"].abs().max() <= half_side
    assert torch.allclose(parameters["means"].std(dim=0), torch.tensor(half_side / 3**0.5), rtol=0.1)
    assert torch.allclose(parameters["scales"], torch.tensor(math.log(0.05)))
    assert torch.allclose(parameters["sh0"], torch.tensor((0.1 - 0.5) / 0.28209), atol=1e-4)
    assert torch.allclose(torch.sigmoid(parameters["transmittances"]), torch.tensor(0.99))


def test_informed_gaussians_are_turned_like_their_frame_and_as_thick_as_a_slice(tiny_dataset, tiny_config):
    dataset = tiny_dataset()
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    poses = dataset.train.poses.copy()
    poses[:, :3, :3] = turn
    dataset = replace(dataset, train=replace(dataset.train, poses=poses))
    parameters = start_of(dataset, tiny_config(initial_scale_mm=1.0, initial_elevation_mm=4.0))
    elevation = rotate(parameters["quats"], torch.tensor([[0.0, 1.0, 0.0]]).expand(len(parameters["quats"]), 3))
    assert torch.allclose(elevation, torch.tensor(turn[:, 1]).float(), atol=1e-6)
    assert torch.allclose(parameters["scales"].exp(), torch.tensor([0.1, 0.4, 0.1]))


def test_a_start_by_detail_has_more_and_smaller_gaussians_where_the_frames_show_some(tiny_dataset, tiny_config):
    dataset = tiny_dataset()
    images = np.full_like(dataset.train.images, 100)
    middle = images.shape[2] // 2
    images[:, ::8, middle:] = 200
    dataset = replace(dataset, train=replace(dataset.train, images=images))
    config = tiny_config(max_gaussians=2_000, initial_scale_mm=1.0, transmittance=False)
    parameters = whole_start_of(dataset, config, by_detail=True).parameters
    x_mm = parameters["means"][:, 0].numpy() * 10.0 + Geometry.of(dataset).centre_mm[0]
    is_plain = x_mm < dataset.train.poses[0, 0, 3] - 2.0 * DETAIL_MM
    lateral, _, axial = parameters["scales"].exp().unbind(1)
    assert 0 < is_plain.sum() < 0.2 * len(x_mm)
    assert lateral[is_plain].min() > lateral[~is_plain].median()
    assert torch.allclose(lateral, WIDER * axial)


def test_gaussians_beyond_an_end_are_the_thicker_the_farther_they_lie(tiny_dataset, tiny_config):
    dataset = tiny_dataset()
    parameters = start_of(dataset, tiny_config(max_gaussians=500, initial_elevation_mm=0.3))
    y = parameters["means"][:, 1].double().numpy() * 10.0 + Geometry.of(dataset).centre_mm[1]
    planes = dataset.train.poses[:, 1, 3]
    beyond_mm = np.maximum(np.maximum(planes.min() - y, y - planes.max()), 0.0)
    thickness_mm = parameters["scales"][:, 1].exp().numpy() * 10.0
    assert np.allclose(
        thickness_mm, np.clip(0.5 * beyond_mm, 0.3, 0.9 * Geometry.of(dataset).scene_scale_cm), rtol=1e-3
    )
    assert (beyond_mm > 1.0).sum() > 20


def test_what_lies_in_a_shadow_begins_as_bright_as_beside_it_and_keeps_a_floor(tiny_dataset, tiny_config):
    dataset = tiny_dataset(height=60, width=40)
    images = np.full_like(dataset.train.images, 100)
    images[:, 20:, 10:16] = 3  # a shadow below something of the usual brightness
    images[:, 20:30, 30:36] = 3  # a vessel: the beam goes on
    images[:, 0, 0] = 101
    dataset = replace(dataset, train=replace(dataset.train, images=images))
    start = whole_start_of(dataset, tiny_config(max_gaussians=8000))
    x, _, z = (start.parameters["means"].double().numpy() * 10.0 + Geometry.of(dataset).centre_mm).T - [
        [30.0],
        [0.0],
        [10.0],
    ]
    row, column = (z / 25.0 * 60).astype(int), ((x / 20.0 + 0.5) * 40).astype(int)
    scene = GaussianScene.from_splats(start.parameters, info=SceneInfo(intensity="sigmoid"))
    intensity = reference.intensity(scene, torch.zeros(3))
    shadowed = (row > 30) & (row < 45) & (column > 11) & (column < 14)
    vessel = (row > 22) & (row < 27) & (column > 31) & (column < 34)
    assert shadowed.sum() > 10
    assert vessel.sum() > 5
    assert intensity[shadowed].numpy() == pytest.approx(100 / 255, abs=0.05)
    assert start.floor[shadowed].numpy() == pytest.approx(0.9 * 100 / 255, abs=0.05)
    assert float(intensity[vessel].max()) < 0.05
    assert float(start.floor[~shadowed & (column > 20)].max()) == 0.0
    assert float(whole_start_of(dataset, tiny_config(transmittance=False)).floor.max()) == 0.0


def intensity_of(sh0, name):
    splats = {key: torch.ones(shape) for key, shape in expected_shapes(len(sh0), 0).items()}
    scene = GaussianScene.from_splats({**splats, "sh0": sh0.reshape(-1, 1, 1)}, info=SceneInfo(intensity=name))
    return reference.intensity(scene, torch.zeros(3))


@pytest.mark.parametrize(("name", "low", "high"), [("released", 0.501, 0.998), ("sigmoid", 0.02, 0.98)])
def test_gives_the_intensity(name, low, high):
    wanted = torch.linspace(0.0, 1.0, 11)
    assert torch.allclose(intensity_of(sh0_of_intensity(wanted, name), name), wanted.clamp(low, high), atol=1e-6)


def test_released_gaussian_beyond_an_end_has_a_gradient_again():
    sh0 = torch.tensor([-5.0, 5.0]).reshape(2, 1, 1)
    project_sh0(sh0, "released", None)
    sh0.requires_grad_()
    intensity_of(sh0, "released").sum().backward()
    assert bool((sh0.grad > 0.28).all())


def test_sigmoid_is_left_alone():
    sh0 = torch.tensor([-50.0, 50.0]).reshape(2, 1, 1)
    project_sh0(sh0, "sigmoid", least_sh0(torch.zeros(2), "sigmoid"))
    assert sh0.flatten().tolist() == [-50.0, 50.0]


@pytest.mark.parametrize("name", ["released", "sigmoid"])
def test_a_floor_is_the_least_intensity(name):
    sh0 = torch.tensor([-5.0, 0.5, -0.4]).reshape(3, 1, 1)
    free = sh0.clone()
    project_sh0(free, name, None)
    project_sh0(sh0, name, least_sh0(torch.tensor([0.6, 0.6, 0.0]), name))
    assert intensity_of(sh0, name)[0].item() == pytest.approx(0.6)
    assert torch.equal(sh0[1:], free[1:])


def test_lengths_of_a_straight_sweep(tiny_dataset):
    dataset = tiny_dataset(frames=9, spacing_mm=2.0)  # frames 2 and 6 are held out: 0 1 3 4 5 7 8 are left
    geometry = Geometry.of(dataset)
    assert geometry.frame_spacing_mm == pytest.approx(2.0)
    reach_mm = math.hypot(10.0, 8.0, 12.5)
    assert geometry.scene_scale_cm == pytest.approx(1.1 * reach_mm / 10.0)
    assert geometry.pixel_mm == pytest.approx(1.25)
    assert geometry.initial_scale_mm == pytest.approx(1.25)  # a pixel is more than half a spacing
    assert geometry.out_of_plane_mm == 0.0  # six frames cannot tell
    assert geometry.least_out_of_plane_mm(views_between=0.0) == pytest.approx(3.0)
    assert geometry.least_out_of_plane_mm(views_between=0.5) == 0.0
    assert (geometry.steps(0.75), geometry.steps(0.0)) == (500, 250)
    assert Geometry.of(tiny_dataset(frames=40)).steps(0.75) == 2 * 15 * 30
    assert geometry.initial_elevation_mm(0.0) == pytest.approx(2.0)
    assert geometry.initial_elevation_mm(9.0) == pytest.approx(4.5)


def test_a_large_volume_that_is_seen_finely_gets_more_gaussians_and_steps():
    usual = Geometry(
        np.zeros(3), 10.0, 1.0, 0.2, 0.0, 14_000_000, distinct_pixels=0, shared_detail=0.0, frame_count=200
    )
    assert (usual.gaussian_count(0.5), usual.steps(0.5)) == (150_000, 750)  # they are few for so many pixels
    less = replace(usual, pixel_count=3_000_000)
    assert (less.gaussian_count(0.5), less.steps(0.5)) == (150_000, round(1_500 * (150 / 240) ** 0.5))
    assert replace(usual, pixel_count=1_875_000).steps(0.5) == 1_500
    large = replace(usual, distinct_pixels=12_000_000)
    assert (large.gaussian_count(0.5), large.steps(0.5)) == (600_000, 3_000)
    assert large.gaussian_count(0.0) == 480_000
    some = replace(large, distinct_pixels=3_000_000)
    assert (some.gaussian_count(0.5), some.steps(0.5)) == (240_000, 1_200)
    hardly = replace(large, distinct_pixels=1_875_100)
    assert (hardly.gaussian_count(0.5), hardly.steps(0.5)) == (150_008, 750)  # no leap beside `usual`
    assert replace(large, frame_count=20).steps(0.5) == 600


@pytest.mark.parametrize(("shared", "pixels_per_gaussian"), [(0.0, 25.0), (0.375, 18.5), (1.0, 12.0)])
def test_frames_with_the_same_detail_get_more_gaussians(tiny_dataset, probe, shared, pixels_per_gaussian):
    dataset = tiny_dataset(frames=9, height=160, width=128, probe=probe)
    train = dataset.train
    white = np.random.default_rng(5).normal(0.0, 20.0, (len(train) + 1, *train.images.shape[1:]))
    images = 128.0 + shared**0.5 * white[-1] + (1.0 - shared) ** 0.5 * white[:-1]
    geometry = Geometry.of(replace(dataset, train=replace(train, images=images.round().astype(np.uint8))))
    assert geometry.shared_detail == pytest.approx(shared, abs=0.01)
    assert geometry.gaussian_count(0.5) == pytest.approx(2 * train.images.size / pixels_per_gaussian, rel=0.02)


def test_detail_is_compared_where_the_poses_say_that_it_lies(tiny_dataset):
    train = tiny_dataset(frames=9, height=160, width=128).train
    white = np.random.default_rng(5).integers(90, 170, train.images.shape[1:], np.uint8)
    shaken = np.stack([np.roll(white, place % 2, axis=0) for place in range(len(train))])
    poses = train.poses.copy()
    poses[1::2, :3, 3] -= train.pixel_mm[0] * poses[1::2, :3, 2]
    assert shared_detail(replace(train, images=shaken, poses=poses)) > 0.95
    assert shared_detail(replace(train, images=shaken)) < 0.1
    assert shared_detail(train.select([0])) == 0.0


def test_pixels_that_are_black_or_seen_again_are_not_distinct(tiny_dataset, monkeypatch):
    dataset = tiny_dataset(frames=9, spacing_mm=0.5)
    dataset.train.images[:, : dataset.train.height // 2] = 0
    lit = np.count_nonzero(dataset.train.images >= 8)
    assert Geometry.of(dataset).distinct_pixels == lit
    monkeypatch.setattr("ultragray.learn.training.geometry.out_of_plane_range_mm", lambda sweep: 4.0)
    assert Geometry.of(dataset).distinct_pixels == lit // 4


def test_spacing_of_a_raster_is_that_across_the_frames(tiny_dataset):
    """Frames of the next lane lie in almost the same planes, but they are not neighbours."""
    sweep = tiny_dataset(frames=12, spacing_mm=1.0).train
    poses = np.concatenate([sweep.poses, sweep.poses])
    poses[len(sweep) :, 0, 3] += 30.0
    poses[len(sweep) :, 1, 3] += 0.1
    images = np.concatenate([sweep.images, sweep.images])
    both = replace(sweep, images=images, poses=poses, frame_numbers=np.arange(len(poses)))
    assert frame_spacing_mm(both) == pytest.approx(1.0)


def test_spacing_of_a_tilt_is_that_of_the_image_points(tiny_dataset):
    sweep = tiny_dataset(probe=LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=40.0)).train
    poses = np.tile(np.eye(4), (len(sweep), 1, 1))
    step = math.radians(1.0)
    for number, pose in enumerate(poses):
        c, s = math.cos(number * step), math.sin(number * step)
        pose[1:3, 1:3] = [[c, -s], [s, c]]
    expected = 20.0 * math.sin(step)  # mean of nothing at the face and 40 mm · sin at the far edge
    assert frame_spacing_mm(replace(sweep, poses=poses)) == pytest.approx(expected, rel=1e-3)


def test_every_frame_is_seen_equally_often():
    sampler = BatchSampler(10, 4, torch.Generator().manual_seed(0))
    batches = [sampler.next_batch() for _ in range(5)]
    assert [len(batch) for batch in batches] == [4] * 5
    assert Counter(torch.cat(batches).tolist()) == dict.fromkeys(range(10), 2)
    assert torch.cat(batches[:2]).tolist() != sorted(torch.cat(batches[:2]).tolist())


def test_batch_holds_each_frame_once_at_most():
    assert sorted(BatchSampler(3, 8, torch.Generator()).next_batch().tolist()) == [0, 1, 2]


def test_shifts_follow_the_squared_cosine():
    generator = torch.Generator().manual_seed(0)
    shifts = np.array([out_of_plane_shift_mm(2.0, generator) for _ in range(4000)])
    assert np.abs(shifts).max() <= 1.0
    assert abs(shifts.mean()) < 0.03
    # The density 2·cos²(πx) on [−½, ½] has the variance 1/12 − 1/(2π²); the full range is 2 mm.
    assert shifts.std() == pytest.approx(2.0 * (1 / 12 - 1 / (2 * np.pi**2)) ** 0.5, rel=0.05)


def test_shift_is_along_elevation(random_poses):
    poses = random_poses(4)
    shifted = shift_out_of_plane(poses, 1.5)
    in_probe = np.einsum("cji,cj->ci", poses[:, :3, :3], shifted[:, :3, 3] - poses[:, :3, 3])
    assert np.allclose(in_probe, (0.0, 1.5, 0.0))
    assert np.array_equal(shifted[:, :3, :3], poses[:, :3, :3])


@pytest.mark.parametrize("blur_mm", [4.0, 8.0])
def test_out_of_plane_range_follows_the_blur_of_the_frames(blur_mm):
    """Noisy slices through a field that is smooth over `blur_mm`: noise widens the range, detail narrows it."""
    rng = np.random.default_rng(5)
    y = 0.5 * np.arange(80)
    phases, rates = rng.uniform(0, 2 * np.pi, 400), 2 * np.pi / (blur_mm * rng.uniform(2.0, 4.0, 400))
    images = 128 + 40 * np.sin(np.outer(y, rates) + phases) + rng.normal(0.0, 20.0, (80, 400))
    poses = np.tile(np.eye(4), (80, 1, 1))
    poses[:, 1, 3] = y
    frames = np.clip(images, 0, 255).astype(np.uint8).reshape(80, 20, 20)
    sweep = Sweep(frames, poses, LinearProbe(20.0, 0.0, 20.0), np.arange(80), "waves")
    assert blur_mm / 4 <= out_of_plane_range_mm(sweep) <= 0.75 * blur_mm


def test_frames_far_apart_tell_no_out_of_plane_range(tiny_dataset):
    assert out_of_plane_range_mm(tiny_dataset(spacing_mm=30.0).train) == 0.0
    still = tiny_dataset(spacing_mm=0.0).train
    assert out_of_plane_range_mm(still) == 0.0


@pytest.mark.parametrize(("frames", "spacing_mm"), [(3, 10.0), (6, 5.0), (12, 3.0), (20, 1.5), (3, 80.0)])
def test_out_of_plane_range_does_not_run_away_where_speckle_tells_nothing(frames, spacing_mm):
    """Frames of pure speckle are best predicted by the mean of them all, however far they lie apart."""
    speckle = np.random.default_rng(2).rayleigh(40.0, (frames, 20, 20)).clip(0, 255).astype(np.uint8)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 1, 3] = spacing_mm * np.arange(frames)
    sweep = Sweep(speckle, poses, LinearProbe(20.0, 0.0, 20.0), np.arange(frames), "speckle")
    assert out_of_plane_range_mm(sweep) <= 8.0


HEIGHT, WIDTH = 100, 60


def speckled(sweep, level=90.0):
    noise = np.random.default_rng(0).gamma(4.0, level / 4.0, (len(sweep), HEIGHT, WIDTH))
    return np.clip(noise, 0, 255).astype(np.uint8)


def evidence(sweep, images):
    return Shadows(replace(sweep, images=images))


def test_a_shadow_lasts_to_the_end_of_the_line_and_a_vessel_does_not(tiny_dataset):
    sweep = tiny_dataset().train
    images = speckled(sweep)
    images[:, 30:, 10:20] //= 20
    images[:, 30:60, 40:50] //= 20
    beam = evidence(sweep, images).of(0)
    assert beam.share[35:, 12:18].mean() < 0.2
    assert beam.share[:25, 12:18].mean() > 0.9
    assert beam.share[:, 40:50].mean() > 0.9
    assert beam.echo[35:, 12:18].mean() == pytest.approx(90 / 255, rel=0.2), "as bright as tissue with the whole beam"


def test_half_of_the_beam_is_told(tiny_dataset):
    sweep = tiny_dataset().train
    images = speckled(sweep)
    images[:, 30:, 10:20] //= 2
    left = evidence(sweep, images).of(0).share
    assert left[35:85, 12:18].mean() == pytest.approx(0.5, abs=0.12)


def test_a_depth_that_is_dark_everywhere_is_no_evidence(tiny_dataset):
    sweep = tiny_dataset().train
    dots = np.zeros((len(sweep), HEIGHT, WIDTH), np.uint8)
    dots[:, 40:43, 20:24] = 250
    dots[:, 0, 0] = 1
    assert not evidence(sweep, dots).of(0).is_shadowed.any()
    fading = speckled(sweep)
    fading[:, 60:] = 2
    assert evidence(sweep, fading).of(0).share[:, 5:-5].mean() > 0.95


@pytest.mark.parametrize("level", [0, 1])
def test_a_line_without_contact_casts_no_shadow(tiny_dataset, level):
    sweep = tiny_dataset().train
    images = speckled(sweep)
    images[:, :, 10:20] = level
    assert not evidence(sweep, images).of(0).is_shadowed[:, 14:16].any()
