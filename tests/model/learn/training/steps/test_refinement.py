"""Duplicate, split, prune; what stays keeps its place."""

import math

import torch

from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.optimizer import PullStatistics, refine, rotate

SCENE_SCALE_CM = 10.0


def splats(sizes_cm):
    count = len(sizes_cm)
    scales = torch.log(torch.tensor(sizes_cm)[:, None].repeat(1, 3))
    scales[:, 1:] -= 1.0  # the largest decides
    return {
        "means": torch.arange(count * 3, dtype=torch.float32).reshape(count, 3),
        "scales": scales,
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        "transmittances": torch.arange(count, dtype=torch.float32),
        "sh0": torch.full((count, 1, 1), -0.5),
        "shN": torch.zeros((count, 3, 1)),
    }


def refined(sizes_cm, pull, limit, **settings):
    config = TrainingConfig.preset("paper", **settings)
    return refine(
        splats(sizes_cm),
        torch.tensor(pull),
        limit=limit,
        scene_scale_cm=SCENE_SCALE_CM,
        config=config,
        generator=torch.Generator().manual_seed(0),
    )


def by_parent(parameters):
    """The rows in the order of the Gaussians that they come from, which `splats` numbers by their transmittance."""
    order = torch.argsort(parameters["transmittances"], stable=True)
    return {name: tensor[order] for name, tensor in parameters.items()}


def test_pulled_gaussians_are_duplicated_or_split_by_their_size():
    found, origin, parent = refined([0.05, 0.05, 0.5, 0.5], [0.0, 1e-4, 0.0, 1e-4], limit=100)
    assert sorted(parent.tolist()) == [0, 1, 1, 2, 3, 3]
    assert torch.equal(parent[origin >= 0], origin[origin >= 0])
    assert sorted(origin.tolist()) == [-1, -1, -1, 0, 1, 2]
    found = by_parent(found)
    assert found["transmittances"].tolist() == [
        0.0,
        1.0,
        1.0,
        2.0,
        3.0,
        3.0,
    ]  # the duplicate beside its like, two halves
    assert torch.equal(found["means"][1], found["means"][2])
    halves = slice(4, 6)
    assert torch.allclose(found["scales"][halves, 0], torch.tensor(math.log(0.5 / 1.6)))
    assert torch.allclose(found["sh0"][halves], torch.tensor(-1.5))
    assert torch.allclose(found["sh0"][:4], torch.tensor(-0.5))
    offsets = found["means"][halves] - splats([0.5] * 4)["means"][3]
    assert bool((offsets != 0).all())
    assert not torch.equal(offsets[0], offsets[1])


def test_halves_are_drawn_from_the_gaussian():
    count = 2000
    found, origin, _ = refined([0.5] * count, [1.0] * count, limit=2 * count)
    assert bool((origin == -1).all())
    offsets = by_parent(found)["means"] - splats([0.5] * count)["means"].repeat_interleave(2, dim=0)
    expected = torch.tensor([0.5, 0.5 / math.e, 0.5 / math.e])
    assert torch.allclose(offsets.std(dim=0), expected, rtol=0.05)


def test_the_most_pulled_come_first_under_the_limit():
    found, _, _ = refined([0.05] * 4, [2e-5, 4e-5, 1e-6, 3e-5], limit=6)
    assert sorted(found["transmittances"].tolist()) == [0.0, 1.0, 1.0, 2.0, 3.0, 3.0]
    assert len(refined([0.05] * 4, [1.0] * 4, limit=3).parameters["means"]) == 4


def test_even_growth_takes_no_notice_of_the_threshold_but_of_being_seen():
    found, _, _ = refined([0.05] * 3, [1e-9, 0.0, 2e-9], limit=10, growth="even")
    assert sorted(found["transmittances"].tolist()) == [0.0, 0.0, 1.0, 2.0, 2.0]


def test_too_large_and_too_small_are_pruned():
    found, origin, _ = refined([1.1, 0.9, 5e-5, 2e-4], [0.0] * 4, limit=10)
    assert sorted(origin.tolist()) == [1, 3]
    assert found["transmittances"].tolist() == [float(place) for place in origin]


def test_a_half_that_is_small_enough_stays_where_the_whole_would_go():
    found, origin, _ = refined([1.5], [1.0], limit=10)
    assert origin.tolist() == [-1, -1]
    assert len(found["means"]) == 2


def test_pull_is_a_mean_over_the_steps_in_which_a_gaussian_was_seen():
    pull = PullStatistics.empty(3, torch.device("cpu"))
    pull.add(torch.tensor([[3.0, 4.0, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, 0.0]]))
    pull.add(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 4.0], [0.0, 0.0, 0.0]]))
    assert pull.mean().tolist() == [5.0, 3.0, 0.0]


def test_rotate():
    half = math.sqrt(0.5)
    quats = 3.0 * torch.tensor([[half, 0.0, 0.0, half]])  # a quarter turn about z, of any norm
    assert torch.allclose(rotate(quats, torch.tensor([[1.0, 2.0, 3.0]])), torch.tensor([[-2.0, 1.0, 3.0]]), atol=1e-6)
