"""Views between frames and beyond the ends of a sweep."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray.geometry.pose import rotation_angles_deg
from ultragray.learn.training.between import Places, ViewsBetween, draw_places, features_follow_probe, neighbours_of
from ultragray.learn.training.losses import image_loss

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


def test_frames_blend_where_their_features_are(tiny_dataset):
    for with_probe in (True, False):
        sweep = drifting(tiny_dataset().train, with_probe=with_probe)
        assert features_follow_probe(sweep, neighbours_of(sweep)) is with_probe


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


def test_beyond_an_end_the_last_frame_goes_on(tiny_dataset):
    sweep = tiny_dataset().train
    views = ViewsBetween(sweep, neighbours_of(sweep), torch.tensor(sweep.images))
    _, poses, images, _ = views.draw(100, torch.Generator().manual_seed(2))
    last = poses[:, 1, 3] > sweep.poses[-1, 1, 3]
    assert last.sum() > 3
    assert torch.equal(
        images[torch.from_numpy(last)],
        (torch.tensor(sweep.images[-1]).float() / 255.0).expand(int(last.sum()), -1, -1),
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
    image_loss(drawn.weighted(rendered), drawn.images, texture=0.0).backward()
    pull = rendered.grad
    in_doubt, agreed = pull[between][:, 26:34, 10:15].abs().mean(), pull[between][:, :14, 26:].abs().mean()
    assert float(in_doubt) < 0.4 * float(agreed)


def test_what_neither_frame_shows_does_not_count(tiny_dataset):
    sweep = drifting(tiny_dataset().train, with_probe=False)
    views = ViewsBetween(sweep, neighbours_of(sweep), torch.tensor(sweep.images))
    assert not views.follow_probe
    drawn = views.draw(200, torch.Generator().manual_seed(3))
    unseen = drawn.images == 0.0
    assert float(drawn.weights[unseen].sum()) == 0.0
    assert float(drawn.weights[~unseen].min()) > 0.0


def test_frames_that_are_far_apart_count_as_usual(tiny_dataset):
    sweep = tiny_dataset().train
    two = sweep.select([0, len(sweep) - 1])
    drawn = ViewsBetween(two, neighbours_of(two), torch.tensor(two.images)).draw(50, torch.Generator().manual_seed(4))
    assert float(drawn.weights.mean()) > 0.5
