"""The fits of ImplicitVol: schedules, restarts, what has gradients, and fits that end where they must."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ultragray_studies.methods.implicitvol import (
    FieldLearner,
    ImplicitVol,
    RefiningLearner,
    published_epoch,
)
from ultragray_studies.methods.parts import pixel_points_mm

from ..volumes import PROBE, along_elevation, seen

CPU = torch.device("cpu")
SMALL = seen(along_elevation(np.arange(3.0)), (12, 8))


def rate_of(learner: FieldLearner, name: str, step: int, steps: int) -> float:
    learner.set_rates(step, steps)
    rate: float = learner.optimizers[name].param_groups[0]["lr"]
    return rate


def test_the_authors_recipe_is_10_001_epochs_of_the_training_frames() -> None:
    assert ImplicitVol().published_steps(SMALL) == 10_001 * 3


def test_coordinates_are_in_half_heights_of_the_image_from_the_scenes_centre() -> None:
    learner = FieldLearner(SMALL, 0, CPU)
    points = learner.training_points(1).detach().numpy()  # the middle one of three frames
    expected = (pixel_points_mm(PROBE, SMALL.train.poses[1], 12, 8) - SMALL.centre_mm) / 12.5
    np.testing.assert_allclose(points, expected, atol=2e-6)
    assert np.abs(points).max() < 1.0


def test_the_networks_rate_falls_every_10_epochs_to_1_percent() -> None:
    learner = FieldLearner(SMALL, 0, CPU)
    steps = 10_001
    assert [published_epoch(step, 3 * steps) for step in (0, 2, 3, 29, 30, 3 * steps - 1)] == [0, 0, 1, 9, 10, 10_000]
    rates = [rate_of(learner, "field", step, steps) for step in (0, 9, 10, 19, 20)]
    assert rates == pytest.approx([1e-3, 1e-3, 0.9954e-3, 0.9954e-3, 0.9954**2 * 1e-3])
    assert rate_of(learner, "field", steps - 1, steps) == pytest.approx(1e-5, rel=0.01)
    assert rate_of(learner, "field", 39, 40) == pytest.approx(rate_of(learner, "field", 9_750, steps))


def test_the_rate_of_poses_falls_every_100_epochs() -> None:
    learner = RefiningLearner(SMALL, 0, CPU)
    rates = [rate_of(learner, "poses", step, 10_001) for step in (0, 99, 100, 250)]
    assert rates == pytest.approx([1e-3, 1e-3, 0.9e-3, 0.81e-3])


def test_only_the_refined_method_moves_frames() -> None:
    fixed, refining = FieldLearner(SMALL, 0, CPU), RefiningLearner(SMALL, 0, CPU)
    assert not fixed.training_points(0).requires_grad
    assert not any(name.startswith("poses") for name in fixed.model())
    before = refining.training_points(0).detach()
    refining.loss(0, 1_000).backward()  # type: ignore[no-untyped-call]
    for parameter in (refining.poses.angles, refining.poses.shifts):
        assert parameter.grad is not None
        assert (parameter.grad.abs().amax(dim=1) > 0).sum() == 1  # of the frame whose turn it was
    refining.take_step(0, 1_000)
    refining.take_step(1, 1_000)
    refining.take_step(2, 1_000)
    assert not torch.equal(refining.training_points(0).detach(), before)


def test_the_network_restarts_nine_times_in_the_first_half_and_poses_stay() -> None:
    steps, restarts = 60, []
    learner = RefiningLearner(seen(along_elevation(np.arange(2.0)), (6, 5)), 0, CPU)
    for step in range(steps):
        learner.take_step(step, steps)
        if not learner.optimizers["field"].state:
            restarts.append(step + 1)
            poses = learner.poses.angles.detach().clone()
            assert not learner.optimizers["poses"].state
            assert 0.95 / 63 < learner.field.near[0].weight.abs().max() <= 1 / 63  # type: ignore[union-attr]
            assert poses.abs().max() > 0.0
    assert restarts == [3, 6, 9, 12, 15, 18, 21, 24, 27]
    assert learner.poses.shifts.isfinite().all()


def test_a_restart_keeps_the_poses_and_draws_other_weights() -> None:
    learner = RefiningLearner(SMALL, 0, CPU)
    first = learner.field.last.weight.detach().clone()
    with torch.no_grad():
        learner.poses.angles += 0.1
    poses = {name: tensor.clone() for name, tensor in learner.poses.state_dict().items()}
    learner.after_step(499, 10_001)
    assert not torch.equal(learner.field.last.weight, first)
    assert all(torch.equal(tensor, poses[name]) for name, tensor in learner.poses.state_dict().items())
    second = learner.field.last.weight.detach().clone()
    for step in (500, 998, 4_999, 5_499, 9_999):
        learner.after_step(step, 10_001)
    assert torch.equal(learner.field.last.weight, second)


def test_frames_that_moved_together_are_rendered_as_the_tracker_saw_them() -> None:
    learner = RefiningLearner(SMALL, 0, CPU)
    with torch.no_grad():
        learner.poses.shifts += torch.tensor([0.2, -0.1, 0.3])
        moved = learner.field(learner.training_points(1)).clamp(0.0, 1.0).numpy()
    rendered = learner.render(PROBE, SMALL.train.poses[1:2], 12, 8)[0]
    np.testing.assert_allclose(rendered, moved, atol=2e-3)  # the finest octave makes much of a rounding


def test_a_frame_that_moved_alone_leaves_held_out_frames_where_they_are_on_average() -> None:
    learner = RefiningLearner(SMALL, 0, CPU)
    with torch.no_grad():
        learner.poses.shifts[0, 0] += 0.3
    _, translation = learner.poses.common_motion()
    assert translation[0].item() == pytest.approx(0.1, abs=0.02)  # a third of the way: there are three frames
