"""Densify and resample: what goes, what comes instead, and what Adam remembers."""

import torch

from ultragray_studies.methods.ultragauss import follow, is_due, resample


def gaussians(count):
    generator = torch.Generator().manual_seed(0)
    return {
        "means": torch.rand((count, 3), generator=generator),
        "scales": torch.full((count, 3), -1.0),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        "transmittances": torch.full((count,), 1.0),
        "sh0": torch.arange(count).float().reshape(count, 1, 1),
    }


def test_useless_weights_make_room_for_what_is_pulled_at_most():
    before, pull = gaussians(6), torch.tensor([1.0, 9.0, 2.0, 3.0, 4.0, 5.0])
    before["transmittances"][[0, 3]] = -8.0  # α = 3e-4
    after, origin = resample(before, pull, limit=6, scene_scale_cm=1.0, generator=torch.Generator().manual_seed(0))
    numbers = sorted(after["sh0"].flatten().tolist())
    assert numbers == [1.0, 1.0, 2.0, 4.0, 5.0, 5.0]  # 1 and 5 are wider than 0.01 cm: two halves each
    assert sorted(origin.tolist()) == [-1, -1, -1, -1, 2, 4]
    halves = after["scales"][after["sh0"].flatten() == 1.0]
    assert torch.allclose(halves, torch.tensor(-1.0) - torch.log(torch.tensor(1.6)))


def test_new_rows_begin_without_momentum():
    state = {"step": torch.tensor(7.0), "exp_avg": torch.tensor([1.0, 2.0]), "exp_avg_sq": torch.tensor([3.0, 4.0])}
    moved = follow(state, torch.tensor([1, -1, 0]))
    assert moved["exp_avg"].tolist() == [2.0, 0.0, 1.0]
    assert moved["exp_avg_sq"].tolist() == [4.0, 0.0, 3.0]
    assert moved["step"] == 7.0


def test_every_hundredth_step_of_the_first_half_is_due():
    assert [done for done in range(1, 30_001) if is_due(done, 30_000)] == list(range(500, 15_001, 100))
    assert [done for done in range(1, 601) if is_due(done, 600)] == [100, 200, 300]
