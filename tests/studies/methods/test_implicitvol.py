"""ImplicitVol: its network, its schedules and restarts, its refined poses."""

import math

import numpy as np
import pytest
import torch

from ultragray.learn.sweep import mean_axes
from ultragray_studies.methods.implicitvol import (
    FieldLearner,
    FramePoses,
    ImplicitVol,
    RefiningLearner,
    SineField,
    SineLayer,
    angles_of,
    published_epoch,
    rotation_of,
)
from ultragray_studies.methods.parts import pixel_points_mm

from .volumes import PROBE, along_elevation, seen


def new_field(seed=0):
    return SineField(torch.Generator().manual_seed(seed))


def sine_layers(field):
    return [layer for layer in field.modules() if isinstance(layer, SineLayer)]


def test_the_layers_have_the_papers_sizes_and_frequencies():
    layers = sine_layers(new_field())
    sizes = [(layer.weight.shape[1], layer.weight.shape[0]) for layer in layers]
    assert sizes == [(63, 128), *[(128, 128)] * 3, (191, 128), *[(128, 128)] * 3, (128, 64)]
    assert [layer.frequency for layer in layers] == [30.0, *[1.0] * 8]


def test_weights_fill_the_papers_ranges():
    field = new_field()
    first, *later = sine_layers(field)
    for layer, bound in [(first, 1 / 63), *((layer, math.sqrt(6 / layer.weight.shape[1])) for layer in later)]:
        assert 0.95 * bound < layer.weight.abs().max() <= bound
        assert 0.8 * bound < layer.bias.abs().max() <= bound
        assert abs(layer.weight.mean()) < 0.05 * bound
    assert field.last.bias.item() == pytest.approx(0.02)


def test_the_first_layer_is_the_sine_of_30_times_its_sum():
    layer = SineLayer(2, 1, is_first=True)
    layer.load_state_dict({"weight": torch.tensor([[0.1, -0.2]]), "bias": torch.tensor([0.05])})
    found = layer(torch.tensor([0.3, 0.1]))
    assert found.item() == pytest.approx(math.sin(30.0 * (0.03 - 0.02 + 0.05)), abs=1e-6)


CPU = torch.device("cpu")
HALF_HEIGHT_MM = 12.5
QUARTER = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # 90° about y: where Rz Ry Rx is singular


def turned_sweep():
    """Poses that all lie near a quarter turn about y, their refinement, and the scene's centre."""
    poses = along_elevation(np.arange(4) * 1.5)
    for place, pose in enumerate(poses):
        pose[:3, :3] = QUARTER @ rotation_of(torch.tensor([0.02, -0.05, 0.1]).double() * place).numpy()
    dataset = seen(poses, (10, 8))
    return poses, FramePoses(dataset.train, dataset.centre_mm, HALF_HEIGHT_MM, CPU), dataset.centre_mm


def test_a_rotation_is_about_x_then_y_then_z():
    def about(axis, angle):
        angles = torch.zeros(3)
        angles[axis] = angle
        return rotation_of(angles)

    torch.testing.assert_close(about(2, math.pi / 2) @ torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]))
    torch.testing.assert_close(about(0, math.pi / 2) @ torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.0, 1.0]))
    torch.testing.assert_close(about(1, math.pi / 2) @ torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0]))
    together = about(2, 0.3) @ about(1, -0.4) @ about(0, 0.5)
    torch.testing.assert_close(rotation_of(torch.tensor([0.5, -0.4, 0.3])), together)


def test_frames_begin_where_the_tracker_saw_them_near_a_quarter_turn_too():
    poses, refined, centre_mm = turned_sweep()
    pixels_mm = torch.from_numpy(pixel_points_mm(PROBE, np.eye(4), 10, 8)).float()
    for place, pose in enumerate(poses):
        expected = (pixel_points_mm(PROBE, pose, 10, 8) - centre_mm) / HALF_HEIGHT_MM
        np.testing.assert_allclose(refined.points(place, pixels_mm).detach().numpy(), expected, atol=3e-6)
    assert refined.angles.abs().max() < 0.5


def test_the_common_motion_is_the_one_that_all_frames_made():
    poses, refined, _ = turned_sweep()
    turn = rotation_of(torch.tensor([0.1, 0.2, -0.15]).double()).numpy()
    shift = np.array([0.3, -0.2, 0.1])
    axes = mean_axes(poses)
    with torch.no_grad():
        refined.angles.copy_(torch.from_numpy(angles_of(axes.T @ turn @ poses[:, :3, :3])))
        refined.shifts.copy_(refined.shifts @ torch.from_numpy(turn.T).float() + torch.from_numpy(shift))
        rotation, translation = refined.common_motion()
    np.testing.assert_allclose(rotation.numpy(), turn, atol=1e-5)
    np.testing.assert_allclose(translation.numpy(), shift, atol=1e-5)


SMALL = seen(along_elevation(np.arange(3.0)), (12, 8))


def rate_of(learner, name, step, steps):
    learner.set_rates(step, steps)
    return learner.optimizers[name].param_groups[0]["lr"]


def test_the_authors_recipe_is_10_001_epochs_of_the_training_frames():
    assert ImplicitVol().published_steps(SMALL) == 10_001 * 3


def test_coordinates_are_in_half_heights_of_the_image_from_the_scenes_centre():
    learner = FieldLearner(SMALL, 0, CPU)
    points = learner.training_points(1).detach().numpy()  # the middle one of three frames
    expected = (pixel_points_mm(PROBE, SMALL.train.poses[1], 12, 8) - SMALL.centre_mm) / 12.5
    np.testing.assert_allclose(points, expected, atol=2e-6)
    assert np.abs(points).max() < 1.0


def test_the_networks_rate_falls_every_10_epochs_to_1_percent():
    learner = FieldLearner(SMALL, 0, CPU)
    steps = 10_001
    assert [published_epoch(step, 3 * steps) for step in (0, 2, 3, 29, 30, 3 * steps - 1)] == [0, 0, 1, 9, 10, 10_000]
    rates = [rate_of(learner, "field", step, steps) for step in (0, 9, 10, 19, 20)]
    assert rates == pytest.approx([1e-3, 1e-3, 0.9954e-3, 0.9954e-3, 0.9954**2 * 1e-3])
    assert rate_of(learner, "field", steps - 1, steps) == pytest.approx(1e-5, rel=0.01)
    assert rate_of(learner, "field", 39, 40) == pytest.approx(rate_of(learner, "field", 9_750, steps))


def test_the_rate_of_poses_falls_every_100_epochs():
    learner = RefiningLearner(SMALL, 0, CPU)
    rates = [rate_of(learner, "poses", step, 10_001) for step in (0, 99, 100, 250)]
    assert rates == pytest.approx([1e-3, 1e-3, 0.9e-3, 0.81e-3])


def test_only_the_refined_method_moves_frames():
    fixed, refining = FieldLearner(SMALL, 0, CPU), RefiningLearner(SMALL, 0, CPU)
    assert not fixed.training_points(0).requires_grad
    assert not any(name.startswith("poses") for name in fixed.model())
    before = refining.training_points(0).detach()
    refining.loss(0, 1_000).backward()
    for parameter in (refining.poses.angles, refining.poses.shifts):
        assert (parameter.grad.abs().amax(dim=1) > 0).sum() == 1  # of the frame whose turn it was
    refining.take_step(0, 1_000)
    refining.take_step(1, 1_000)
    refining.take_step(2, 1_000)
    assert not torch.equal(refining.training_points(0).detach(), before)


def test_the_network_restarts_nine_times_in_the_first_half_and_poses_stay():
    steps, restarts = 60, []
    learner = RefiningLearner(seen(along_elevation(np.arange(2.0)), (6, 5)), 0, CPU)
    for step in range(steps):
        learner.take_step(step, steps)
        if not learner.optimizers["field"].state:
            restarts.append(step + 1)
            poses = learner.poses.angles.detach().clone()
            assert not learner.optimizers["poses"].state
            assert 0.95 / 63 < learner.field.near[0].weight.abs().max() <= 1 / 63
            assert poses.abs().max() > 0.0
    assert restarts == [3, 6, 9, 12, 15, 18, 21, 24, 27]
    assert learner.poses.shifts.isfinite().all()


def test_frames_that_moved_together_are_rendered_as_the_tracker_saw_them():
    learner = RefiningLearner(SMALL, 0, CPU)
    with torch.no_grad():
        learner.poses.shifts += torch.tensor([0.2, -0.1, 0.3])
        moved = learner.field(learner.training_points(1)).clamp(0.0, 1.0).numpy()
    rendered = learner.render(PROBE, SMALL.train.poses[1:2], 12, 8)[0]
    np.testing.assert_allclose(rendered, moved, atol=2e-3)  # the finest octave makes much of a rounding
