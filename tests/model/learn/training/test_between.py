"""Views between frames and beyond the ends of a sweep, and what a scene trained with them shows there."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn import functional

from ultragray.geometry.pose import pose_from_position_quaternion
from ultragray.geometry.probe import ConvexProbe, LinearProbe, PhasedProbe, RadialProbe, SteeredProbe
from ultragray.geometry.rotations import rotation_angles_deg
from ultragray.learn.evaluation.baselines import interpolate_planes, predict
from ultragray.learn.evaluation.scoring import render_sweep
from ultragray.learn.sweep import Sweep
from ultragray.learn.training import train
from ultragray.learn.training.between import (
    SMOOTHED,
    Places,
    ViewsBetween,
    blend_in_space,
    draw_places,
    neighbours_of,
    smoothed_sizes,
)
from ultragray.learn.training.losses import image_loss


def placed(sweep, y_mm, *, x_mm=None):
    poses = np.tile(sweep.poses[0], (len(y_mm), 1, 1))
    poses[:, 1, 3] += y_mm
    poses[:, 0, 3] += x_mm or 0.0
    images = np.resize(sweep.images, (len(y_mm), *sweep.images.shape[1:]))
    return replace(sweep, images=images, poses=poses, frame_numbers=np.arange(len(y_mm)))


def test_neighbours_are_the_nearest_on_either_side_whatever_the_order(tiny_dataset):
    neighbours = neighbours_of(placed(tiny_dataset().train, [0.0, 2.0, 1.0, 9.0]))
    found = {tuple(pair): gap for pair, gap in zip(neighbours.pairs.tolist(), neighbours.gaps_mm, strict=True)}
    assert found == {(0, 2): pytest.approx(1.0), (1, 2): pytest.approx(1.0), (1, 3): pytest.approx(7.0)}
    assert neighbours.spacing_mm == pytest.approx(1.0)
    assert list(zip(neighbours.ends.tolist(), neighbours.outward.tolist(), strict=True)) == [(0, -1.0), (3, 1.0)]


def test_a_gap_weighs_as_much_as_it_is_long_and_never_less_than_the_usual_one(tiny_dataset):
    neighbours = neighbours_of(placed(tiny_dataset().train, [0.0, 1.0, 2.0, 2.2, 7.2]))
    weights = neighbours.weights
    assert weights.sum() == pytest.approx(1.0)
    assert (weights[:4] / weights[0]).tolist() == pytest.approx([1.0, 1.0, 1.0, 5.0])
    assert weights[4] / weights[0] == pytest.approx(np.log2(6.25)), "one for each doubling up to a quarter of 25 mm"
    assert neighbours.beyond_mm(np.array([0.0, 1.0])).tolist() == pytest.approx([1.0, 6.25])


def test_a_frame_beside_is_no_neighbour_and_hides_no_end(tiny_dataset):
    sweep = placed(tiny_dataset().train, [0.0, 1.0, 0.5, 1.5], x_mm=[0.0, 0.0, 60.0, 60.0])
    neighbours = neighbours_of(sweep)
    assert neighbours.pairs.tolist() == [[0, 1], [2, 3]]
    assert len(neighbours.ends) == 4


def test_a_probe_held_still_has_no_gaps_but_every_frame_takes_part(tiny_dataset):
    neighbours = neighbours_of(placed(tiny_dataset().train, [0.0, 0.0, 0.0]))
    assert neighbours.spacing_mm == 0.0
    assert neighbours.pairs.tolist() == [[0, 0], [1, 1], [2, 2]]
    assert neighbours.weights[:3].min() > 0.0
    assert len(neighbours.without_ends().ends) == 0


def test_frames_of_a_probe_that_turns_in_place_are_neighbours_by_their_turn(tiny_dataset):
    sweep = placed(tiny_dataset().train, [0.0] * 12)
    poses = sweep.poses.copy()
    angles = np.radians(4.0 * np.arange(12))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angles)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(angles), -np.sin(angles)
    neighbours = neighbours_of(replace(sweep, poses=poses))
    chain = [[place, place + 1] for place in range(11)]
    assert [pair for pair in neighbours.pairs.tolist() if pair[1] - pair[0] == 1] == chain
    assert len(neighbours.ends) == 0


def test_a_frame_that_only_slides_sideways_is_paired_with_itself(tiny_dataset):
    sweep = placed(tiny_dataset().train, [0.0, 0.1, -0.1], x_mm=[0.0, 8.0, -8.0])
    neighbours = neighbours_of(sweep)
    used = {*neighbours.pairs.flatten().tolist(), *neighbours.ends.tolist()}
    assert used == {0, 1, 2}
    assert neighbours.weights.sum() == pytest.approx(1.0)


PIXELS_A_MM = 2.0


def drifting(sweep, *, with_probe):
    """The probe slides sideways while it moves on; what it sees stays in space, or in the image."""
    count, height, width = 12, 40, 40
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = np.arange(count)
    poses[:, 0, 3] = np.arange(count) * 0.5
    texture = np.random.default_rng(0).integers(20, 230, (height, width + 2 * count)).astype(np.uint8)
    shifts = [0 if with_probe else round(place * 0.5 * PIXELS_A_MM) for place in range(count)]
    images = np.stack([texture[:, shift : shift + width] for shift in shifts])
    return replace(sweep, images=images, poses=poses, frame_numbers=np.arange(count))


def test_poses_between_move_the_middle_of_the_image_straight_and_turn_evenly(tiny_dataset):
    sweep = tiny_dataset().train
    poses = sweep.poses[:2].copy()
    angle = np.radians(8.0)
    poses[1, 1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    sweep = replace(sweep, images=sweep.images[:2], poses=poses, frame_numbers=np.arange(2))
    found = Places(np.array([[0, 1]] * 3), np.array([0.0, 0.25, 1.0]), np.zeros(3)).poses(sweep)
    assert np.allclose(found[[0, 2]], poses)
    assert rotation_angles_deg(found[1:2], poses)[0].tolist() == pytest.approx([2.0, 6.0])
    middle = np.append(sweep.probe.corners_mm().mean(axis=0), 1.0)
    assert np.allclose(found[1] @ middle, (0.75 * poses[0] + 0.25 * poses[1]) @ middle)


def test_places_fill_the_gaps_by_their_length(tiny_dataset):
    sweep = tiny_dataset(frames=12).train  # every fourth frame is missing
    neighbours = neighbours_of(sweep)
    places = draw_places(neighbours, 4000, torch.Generator().manual_seed(0))
    y = places.poses(sweep)[places.beyond_mm == 0.0, 1, 3] - sweep.poses[0, 1, 3]
    shares, _ = np.histogram(y, np.linspace(0.0, np.ptp(sweep.poses[:, 1, 3]), 9))
    assert shares.min() > 0.8 * shares.mean()
    beyond = places.beyond_mm[places.beyond_mm != 0.0]
    assert (np.abs(beyond) <= neighbours.extent_mm + 1e-9).all()
    assert {float(np.sign(value)) for value in beyond} == {-1.0, 1.0}


@pytest.mark.parametrize("with_probe", [True, False])
def test_images_between_show_what_is_there(tiny_dataset, with_probe):
    sweep = drifting(tiny_dataset().train, with_probe=with_probe)
    every_other = sweep.select(range(0, len(sweep), 2))
    views = ViewsBetween(every_other, neighbours_of(every_other), torch.tensor(every_other.images))
    _, poses, images, _ = views.draw(600, torch.Generator().manual_seed(1))
    nearest = np.abs(poses[:, None, 1, 3] - sweep.poses[:, 1, 3]).argmin(axis=1)
    close = np.abs(poses[:, 1, 3] - sweep.poses[nearest, 1, 3]) < 0.1
    truth = torch.tensor(sweep.images[nearest]).float() / 255.0
    errors = (images - truth)[:, :, 4:-4].abs().mean(dim=(1, 2))[torch.from_numpy(close)]
    assert len(errors) > 5
    assert float(errors.max()) < 0.08


def test_beyond_an_end_views_are_those_of_the_last_frame(tiny_dataset):
    sweep = tiny_dataset().train
    views = ViewsBetween(sweep, neighbours_of(sweep), torch.tensor(sweep.images))
    _, poses, images, _ = views.draw(100, torch.Generator().manual_seed(2))
    last = poses[:, 1, 3] > sweep.poses[-1, 1, 3]
    assert last.sum() > 3
    assert torch.equal(
        images[torch.from_numpy(last)], (torch.tensor(sweep.images[-1]).float() / 255.0).expand(int(last.sum()), -1, -1)
    )


@pytest.mark.parametrize("with_probe", [True, False])
def test_where_neighbours_disagree_a_blend_counts_less(tiny_dataset, with_probe):
    sweep = drifting(tiny_dataset().train, with_probe=with_probe)
    images = sweep.images.copy()
    images[1::2, 20:, 5:20] //= 20
    shadowed = replace(sweep, images=images)
    views = ViewsBetween(shadowed, neighbours_of(shadowed), torch.tensor(images))
    views.follow_probe = with_probe
    drawn = views.draw(40, torch.Generator().manual_seed(3))
    between = torch.from_numpy((drawn.poses[:, 1, 3] > 0.0) & (drawn.poses[:, 1, 3] < len(sweep) - 1))
    rendered = (0.9 * drawn.images + 0.07).requires_grad_()
    image_loss(rendered, drawn.images, 0.0, drawn.weights).backward()
    pull = rendered.grad
    in_doubt, agreed = pull[between][:, 26:34, 10:15].abs().mean(), pull[between][:, :14, 26:].abs().mean()
    assert float(in_doubt) < 0.4 * float(agreed)


def test_differences_are_averaged_over_a_square_that_ends_with_the_image():
    differences = torch.randn(2, 13, 31, generator=torch.Generator().manual_seed(0))
    pooled = functional.avg_pool2d(differences, SMOOTHED, 1, SMOOTHED // 2, count_include_pad=False).abs()
    assert (smoothed_sizes(differences) - pooled).abs().max() < 1e-6


def test_what_neither_frame_shows_does_not_count(tiny_dataset):
    sweep = drifting(tiny_dataset().train, with_probe=False)
    views = ViewsBetween(sweep, neighbours_of(sweep), torch.tensor(sweep.images))
    assert not views.follow_probe
    drawn = views.draw(200, torch.Generator().manual_seed(3))
    unseen = drawn.images == 0.0
    assert float(drawn.weights[unseen].sum()) == 0.0
    assert float(drawn.weights[~unseen].min()) > 0.0


SIZE = 48
PROBES = (
    LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=30.0),
    SteeredProbe(width_mm=40.0, steering_deg=15.0, near_mm=0.0, far_mm=30.0),
    ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=90.0),
    PhasedProbe(opening_angle_deg=80.0, far_mm=80.0),
    RadialProbe(near_mm=1.0, far_mm=30.0),
)


def two_frames(probe, apart_mm=4.0):
    """Smooth frames that close in themselves from right to left, the second one moved and turned within its plane."""
    rows, columns = np.meshgrid(np.arange(SIZE), np.arange(SIZE), indexing="ij")
    waves = [np.sin(rows / 5 + phase) + np.cos(2 * np.pi * columns / SIZE + phase) for phase in (0.0, 1.0)]
    turn = np.radians(6.0)
    moved = pose_from_position_quaternion([1.5, apart_mm, -1.0], [np.cos(turn / 2), 0.0, np.sin(turn / 2), 0.0])
    images = np.stack([np.round(127 + 60 * wave) for wave in waves]).astype(np.uint8)
    return Sweep(images, np.stack([np.eye(4), moved]), probe, np.arange(2), "two frames")


def between(*heights_mm):  # [V, 4, 4] mm
    poses = np.tile(np.eye(4), (len(heights_mm), 1, 1))
    poses[:, 1, 3] = heights_mm
    poses[:, 0, 3] = 0.3
    return poses


def blended(sweep, poses):
    sides = (torch.from_numpy(sweep.images).float() / 255.0).expand(len(poses), -1, -1, -1)
    return blend_in_space(sides, np.stack([sweep.poses] * len(poses)), poses, sweep.probe).images.numpy()


@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.kind)
def test_planes_between_two_frames_are_those_of_the_baseline(probe):
    sweep, poses = two_frames(probe), between(0.5, 2.0, 3.0)
    expected = interpolate_planes(sweep, poses)
    errors = np.abs(blended(sweep, poses) - expected)
    assert expected.std() > 0.1
    assert np.quantile(errors, 0.99) < 2e-3  # at the outline, pixels may fall inside here and outside there
    assert np.quantile(np.abs(expected - expected.mean()), 0.5) > 0.05


def test_what_no_frame_shows_is_black_and_what_one_shows_is_its():
    sweep = two_frames(PROBES[0])
    aside = between(2.0, 2.0)
    aside[:, 0, 3] = [100.0, 25.0]
    far, near = blended(sweep, aside)
    assert far.max() == 0.0
    assert near[:, -SIZE // 4 :].max() == 0.0
    assert near[:, : SIZE // 4].min() > 0.0


def psnr_db(images, truth):
    return float((-10.0 * np.log10(np.square(images - truth / 255.0).mean(axis=(1, 2)))).mean())


def with_gap(dataset, first, last):
    """The frames from `first` to `last` of all are held out, no others."""
    places = np.arange(len(dataset.train))
    held_out = (places >= first) & (places <= last)
    return replace(dataset, train=dataset.train.select(places[~held_out]), val=dataset.train.select(places[held_out]))


def test_a_gap_is_as_bright_as_its_edges_tell(tiny_dataset, tiny_config):
    dataset = with_gap(tiny_dataset(frames=40, height=40, width=32, spacing_mm=0.4), 12, 19)
    settings = {"steps": 100, "max_gaussians": 1000, "refinements": 0, "batch_size": 8}
    filled = train(dataset, tiny_config(**settings))
    alone = train(dataset, tiny_config(**settings, views_between=0.0))
    linear = psnr_db(predict(dataset.train, dataset.val.poses, "linear"), dataset.val.images)
    found = [psnr_db(render_sweep(scene, dataset.val), dataset.val.images) for scene in (filled, alone)]
    assert found[0] > linear - 0.5
    assert found[0] > found[1] + 1.0


def test_beyond_an_end_the_last_frame_goes_on(tiny_dataset, tiny_config):
    dataset = with_gap(tiny_dataset(frames=24, height=40, width=32, spacing_mm=0.5), 14, 17)
    scene = train(dataset, tiny_config(steps=60, max_gaussians=1000, refinements=0, batch_size=8))
    assert dataset.val.poses[-1, 1, 3] - dataset.train.poses[-1, 1, 3] > 2.0
    assert psnr_db(render_sweep(scene, dataset.val), dataset.val.images) > 20.0


def test_darkness_that_is_no_shadow_is_not_explained_by_absorption(tiny_dataset, tiny_config):
    dataset = tiny_dataset(frames=16, height=60, width=48)
    rows, columns = np.mgrid[:60, :48]
    spots = [
        np.exp(-((rows - 15) ** 2 + (columns - 10 - place) ** 2) / 8.0)
        + np.exp(-((rows - 35) ** 2 + (columns - 30) ** 2) / 8.0)
        for place in range(len(dataset.train))
    ]
    images = (230.0 * np.array(spots)).astype(np.uint8)
    dataset = replace(dataset, train=replace(dataset.train, images=images), val=dataset.val.select([]))
    settings = {"steps": 100, "max_gaussians": 1000, "refinements": 0, "batch_size": 8}
    scene = train(dataset, tiny_config(**settings))
    assert render_sweep(scene, dataset.train, output="transmittance").mean() > 0.97


@pytest.mark.long
def test_absorption_costs_nothing_where_frames_show_a_shadow(tiny_dataset, tiny_config):
    dataset = tiny_dataset(frames=16, height=60, width=48)
    speckle = np.random.default_rng(0).gamma(4.0, 22.0, (len(dataset.train), 60, 48))
    speckle[:, 18:22, 15:30] = 230.0
    speckle[:, 22:, 15:30] /= 20.0
    images = np.clip(speckle, 0, 255).astype(np.uint8)
    dataset = replace(dataset, train=replace(dataset.train, images=images), val=dataset.val.select([]))
    settings = {"steps": 150, "max_gaussians": 1500, "refinements": 0, "batch_size": 8}
    scene = train(dataset, tiny_config(**settings, absorption_penalty=1.0))
    transmittance = render_sweep(scene, dataset.train, output="transmittance")
    assert transmittance[:, 35:, 18:27].mean() < 0.3
    assert transmittance[:, :, 38:].mean() > 0.97


@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.kind)
@pytest.mark.parametrize("by_pixel", [True, False])
def test_the_kernel_draws_views_as_torch_does(probe, by_pixel):
    sweep = two_frames(probe)
    views = ViewsBetween(sweep, neighbours_of(sweep), torch.tensor(sweep.images))
    views.follow_probe = by_pixel
    places = Places(np.array([[0, 1], [0, 1], [0, 0]]), np.array([0.2, 0.7, 0.0]), np.array([0.0, 0.0, -3.0]))
    poses = places.poses(sweep)
    for own, expected in zip(views.shown(places, poses), views.plainly_shown(places, poses), strict=True):
        errors = (own - expected).abs()
        assert expected.std() > 0.01
        assert float(errors.quantile(0.999)) < 1e-4  # at the outline, pixels may fall inside here and outside there


def test_the_thread_count_does_not_change_a_view(tiny_dataset):
    sweep = drifting(tiny_dataset().train, with_probe=False)
    views = ViewsBetween(sweep, neighbours_of(sweep), torch.tensor(sweep.images))
    before, found = torch.get_num_threads(), []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        found.append(views.draw(5, torch.Generator().manual_seed(0)))
    torch.set_num_threads(before)
    assert torch.equal(found[0].images, found[1].images)
    assert torch.equal(found[0].weights, found[1].weights)
