"""Fields learned from slices: ImplicitVol, RapidVol, what they share; and the methods by name."""

import math

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe
from ultragray.errors import InvalidArgument
from ultragray.geometry.rotations import mean_axes
from ultragray.learn.evaluation.baselines import predict
from ultragray.learn.evaluation.methods import NAMES
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
from ultragray_studies.methods.learner import LearnedMethod
from ultragray_studies.methods.method import Budget, FitRun
from ultragray_studies.methods.parts import SliceLearner, frame_of_step, pixel_points_mm
from ultragray_studies.methods.rapidvol import TriPlaneLearner, TriPlanes
from ultragray_studies.methods.registry import METHODS, chosen_methods
from ultragray_studies.methods.ultranerf import VARIANTS

from .conftest import PROBE, along_elevation, one_frame, psnr_of_fit, seen, steps_of


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


def new_planes(seed=0):
    return TriPlanes(torch.Generator().manual_seed(seed))


def parameters_in(module):
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_planes_and_the_decoder_have_so_many_parameters():
    field = new_planes()
    assert field.planes.numel() == 3 * 16 * 128 * 128
    assert parameters_in(field.decoder) == (16 * 64 + 64) + (64 * 64 + 64) + (64 + 1)
    assert parameters_in(field) == 786_432 + 5_313


def test_a_product_is_that_of_the_three_planes_by_hand():
    field = new_planes()
    node = 2.0 / 127.0  # between two nodes
    with torch.no_grad():
        field.planes.zero_()
        # The point lies at x node 10, a quarter after y node 20, and half after z node 30.
        field.planes[0, 3, 20, 10], field.planes[0, 3, 21, 10] = 2.0, 6.0  # xy: rows are y, columns x
        field.planes[1, 3, 30, 20], field.planes[1, 3, 31, 20] = 1.0, 3.0  # yz: rows are z, columns y
        field.planes[2, 3, 30, 10], field.planes[2, 3, 31, 10] = 10.0, 20.0  # xz: rows are z, columns x
    point = torch.tensor([10.0 * node, 20.25 * node, 30.5 * node]) - 1.0
    found = field.products(point.view(1, 1, 3))[0, 0]
    xy, yz, xz = 0.75 * 2.0 + 0.25 * 6.0, 0.75 * (0.5 * 1.0 + 0.5 * 3.0), 0.5 * 10.0 + 0.5 * 20.0
    assert found[3].item() == pytest.approx(xy * yz * xz, rel=1e-4)
    assert (found[:3] == 0).all()
    assert (found[4:] == 0).all()


def test_beyond_the_box_the_value_at_its_end_goes_on():
    field = new_planes()
    points = torch.tensor([[[1.0, 0.2, -1.0], [1.5, 0.2, -3.0]]])
    torch.testing.assert_close(field(points)[0, 0], field(points)[0, 1])


def test_each_axis_of_the_box_is_scaled_by_its_own_half():
    learner = TriPlaneLearner(SMALL, 0, CPU)
    np.testing.assert_allclose(learner.half_mm, [10.0, 1.0, 12.5])
    points = torch.cat([learner.training_points(place) for place in range(3)]).reshape(-1, 3)
    assert points[:, 1].abs().max().item() == pytest.approx(1.0, abs=1e-5)
    assert points.abs().amax(dim=0).min() > 0.8
    assert points.abs().max() < 1.0 + 1e-5


def test_a_sweep_of_one_plane_has_a_box_all_the_same():
    learner = TriPlaneLearner(one_frame(12, 8), 0, CPU)
    assert learner.half_mm[1] == 1.0
    assert np.isfinite(learner.render(SMALL.probe, SMALL.train.poses, 12, 8)).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_field_begins_above_0_everywhere_without_products_near_0(seed):
    field = new_planes(seed)
    points = 2.0 * torch.rand((40, 40, 3), generator=torch.Generator().manual_seed(seed)) - 1.0
    assert field.products(points).abs().min() > 0.7
    assert (field(points) - 0.5).abs().max() < 0.2


def test_rates_fall_to_1_percent():
    learner = TriPlaneLearner(SMALL, 0, CPU)
    learner.set_rates(0, 100)
    assert [one.param_groups[0]["lr"] for one in learner.optimizers.values()] == [1e-2, 1e-3]
    learner.set_rates(50, 100)
    assert [one.param_groups[0]["lr"] for one in learner.optimizers.values()] == pytest.approx([1e-3, 1e-4])


SLICE_METHODS = ("implicitvol", "implicitvol-refined", "rapidvol")
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=60.0)


def learner_of(name, probe=PROBE):
    method = METHODS[name]
    assert isinstance(method, LearnedMethod)
    dataset = seen(along_elevation(np.array([0.0, 2.0, 3.0])), (12, 8), probe)
    learner = method.learner(dataset, Budget.author(), 5, torch.device("cpu"))
    assert isinstance(learner, SliceLearner)
    return learner


def test_each_epoch_takes_each_frame_once_in_an_order_of_its_own():
    epochs = [[frame_of_step(7 * epoch + place, 7, seed=3) for place in range(7)] for epoch in range(4)]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 4
    assert epochs[0] != [frame_of_step(place, 7, seed=4) for place in range(7)]


@pytest.mark.parametrize("name", SLICE_METHODS)
def test_a_field_that_shows_the_image_has_no_loss(name, monkeypatch):
    learner = learner_of(name)
    place = frame_of_step(0, 3, seed=5)

    def image(points):
        return learner.image(place) + 0.0 * points.sum(dim=-1)

    monkeypatch.setattr(learner, "field", image)
    assert learner.loss(0, 10).item() == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("probe", [PROBE, CONVEX], ids=["linear", "convex"])
@pytest.mark.parametrize("name", SLICE_METHODS)
def test_a_frame_is_taken_at_the_places_of_its_pixels(name, probe, monkeypatch):
    learner = learner_of(name, probe)
    direction = torch.tensor([0.03, 0.02, 0.05])

    def ramp(points):
        return 0.5 + points @ direction

    monkeypatch.setattr(learner, "field", ramp)
    pose = learner.dataset.train.poses[1].copy()
    pose[:3, :3] = [[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]]
    frame = learner.render(probe, pose[None], 12, 8)[0]
    points = (pixel_points_mm(probe, pose, 12, 8) - learner.centre_mm) / learner.half_mm
    np.testing.assert_allclose(frame, 0.5 + points @ direction.numpy(), atol=2e-6)


@pytest.mark.parametrize("name", SLICE_METHODS)
def test_training_points_are_those_of_the_tracked_frames(name):
    learner = learner_of(name, CONVEX)
    for place, pose in enumerate(learner.dataset.train.poses):
        expected = (pixel_points_mm(CONVEX, pose, 12, 8) - learner.centre_mm) / learner.half_mm
        np.testing.assert_allclose(learner.training_points(place).detach().numpy(), expected, atol=2e-6)


def test_the_names_are_those_of_the_registry_in_its_order():
    assert tuple(METHODS) == NAMES


def test_methods_are_chosen_in_the_order_of_tables():
    assert list(chosen_methods(["nearest", "scene", "nearest"])) == ["scene", "nearest"]
    assert chosen_methods(["nearest", "all"]) == METHODS


@pytest.mark.parametrize(("names", "got"), [(["medain"], "'medain'"), (["all", "x"], "'x'"), ([], "none")])
def test_a_method_that_is_not_there_is_refused_with_the_list(names, got):
    with pytest.raises(InvalidArgument, match=f"scene, median, mean, maximum.* got {got}") as caught:
        chosen_methods(names)
    assert caught.value.field == "methods"


@pytest.mark.parametrize("name", ["median", "maximum", "linear", "nearest"])
def test_a_classical_method_predicts_what_the_baseline_does(name, make_dataset):
    dataset = make_dataset()
    fitted = METHODS[name].fit(dataset, Budget.equal(1.0))
    assert (fitted.cost.steps, fitted.cost.of_steps, fitted.cost.is_short) == (0, None, False)
    height, width = dataset.val.height, dataset.val.width
    rendered = fitted.render(dataset.probe, dataset.val.poses, height, width)
    np.testing.assert_array_equal(rendered, predict(dataset.train, dataset.val.poses, name))


# Steps of a short fit, and until a frame of a size is learned.
FIELDS = {
    "implicitvol": (24, 60, (20, 16)),
    "implicitvol-refined": (24, 140, (32, 24)),
    "rapidvol": (16, 200, (20, 16)),
}
SHORT = {**{name: steps for name, (steps, *_) in FIELDS.items()}, **{one.name: 10 for one in VARIANTS}}


@pytest.mark.parametrize("name", SHORT)
def test_a_killed_fit_ends_in_the_model_of_an_undisturbed_one(name, tmp_path):
    method, dataset, told = METHODS[name], seen(along_elevation(np.arange(3.0)), (12, 8)), []
    budget = steps_of(method, SHORT[name])
    stopping = FitRun(folder=tmp_path, report=told.append, should_stop=lambda: len(told) == 7)
    assert method.fit(dataset, budget, stopping) is None
    resumed, undisturbed = method.fit(dataset, budget, FitRun(folder=tmp_path)), method.fit(dataset, budget)
    models = resumed.learner.model(), undisturbed.learner.model()
    assert models[0].keys() == models[1].keys()
    assert all(torch.equal(tensor, models[1][key]) for key, tensor in models[0].items())


@pytest.mark.slow
@pytest.mark.parametrize("name", FIELDS)
def test_a_single_frame_is_fitted_above_30_db(name):
    method, (_, steps, size) = METHODS[name], FIELDS[name]
    assert psnr_of_fit(method, one_frame(*size), steps) > 30.0
