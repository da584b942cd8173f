"""UltraGauss: where it starts, what it renders, what it resamples, what it learns."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, LinearProbe
from ultragray.errors import DatasetInvalid
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.training.optimizer import rotate
from ultragray.rendering.backends.registry import weighted_sums
from ultragray_studies.methods.method import FitRun
from ultragray_studies.methods.parts import Box
from ultragray_studies.methods.registry import METHODS
from ultragray_studies.methods.ultragauss import (
    Field,
    UltraGaussLearner,
    average,
    even_start,
    follow,
    is_due,
    resample,
    shadow,
    wide_start,
)

from ...model.learn.conftest import make_tiny_dataset
from .conftest import steps_of

LINEAR = LinearProbe(width_mm=20.0, near_mm=5.0, far_mm=25.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=60.0)


def sweep_along_elevation(probe):
    """Ten frames, 1 mm apart."""
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, :3, 3] = (30.0, -20.0, 10.0)
    poses[:, 1, 3] += np.arange(10)
    images = np.tile(np.arange(16, dtype=np.uint8), (10, 16, 1))
    frames = Sweep(images, poses, probe, np.arange(10), "made up")
    return Dataset("made up", frames, frames.select([]))


@pytest.mark.parametrize("probe", [LINEAR, CONVEX], ids=["linear", "convex"])
@pytest.mark.parametrize("start", [even_start, wide_start])
def test_means_lie_in_the_space_of_the_frames(start, probe):
    dataset = sweep_along_elevation(probe)
    gaussians = start(dataset, 4_000, torch.Generator().manual_seed(0))
    placed = 10.0 * gaussians["means"].double().numpy() + dataset.centre_mm - (30.0, -20.0, 10.0)
    rows, _ = probe.image_coordinates(placed[:, 0], placed[:, 2])
    assert np.isfinite(rows).mean() > 0.999  # rounding may put one on an edge outside
    assert -0.5001 <= placed[:, 1].min() < -0.4
    assert 9.4 < placed[:, 1].max() <= 9.5001
    depths = np.hypot(placed[:, 0], placed[:, 2]) if probe is CONVEX else placed[:, 2]
    middle = math.sqrt((20.0**2 + 60.0**2) / 2.0) if probe is CONVEX else 15.0  # halves the area of the image
    assert 0.47 < (depths < middle).mean() < 0.53


def test_even_gaussians_are_as_wide_as_their_share_of_the_volume():
    gaussians = even_start(sweep_along_elevation(LINEAR), 500, torch.Generator().manual_seed(0))
    volume_mm3 = 20.0 * 20.0 * 10.0
    assert torch.allclose(10.0 * gaussians["scales"].exp(), torch.tensor((volume_mm3 / 500) ** (1 / 3)))


def test_even_gaussians_reach_over_the_gaps_between_frames_along_the_frames_own_elevation():
    """Ten frames, 1 mm apart, turned by a quarter about the axis of depth: elevation lies along -x of the tracker."""
    dataset = sweep_along_elevation(LINEAR)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    poses = dataset.train.poses.copy()
    poses[:, :3, :3] = turn
    poses[:, :3, 3] = poses[:, :3, 3] @ turn.T
    turned = Dataset("turned", replace(dataset.train, poses=poses), dataset.val)
    gaussians = even_start(turned, 50_000, torch.Generator().manual_seed(0))
    side_mm = (20.0 * 20.0 * 10.0 / 50_000) ** (1 / 3)
    assert torch.allclose(10.0 * gaussians["scales"][0].exp(), torch.tensor([side_mm, 0.5, side_mm]))
    along = rotate(gaussians["quats"][:1], torch.tensor([[0.0, 1.0, 0.0]]))
    assert torch.allclose(along, torch.tensor([[-1.0, 0.0, 0.0]]), atol=1e-6)


def test_the_published_start_has_its_precision():
    """L of entries in [4, 5) in the cube of side 2 around the frames: bounds of each entry of L·Lᵀ follow."""
    dataset = sweep_along_elevation(LINEAR)
    gaussians = wide_start(dataset, 300, torch.Generator().manual_seed(0))
    unit_cm = Box.of(dataset.train).largest_half_mm / 10.0
    axes = torch.stack([rotate(gaussians["quats"], axis.expand(300, 3)) for axis in torch.eye(3)], dim=-1)
    precision = (axes * (gaussians["scales"].exp() / unit_cm).pow(-2)[:, None]) @ axes.transpose(1, 2)
    terms = torch.tensor([[1.0, 1.0, 1.0], [1.0, 2.0, 2.0], [1.0, 2.0, 3.0]])
    assert (precision > 16.0 * terms - 0.1).all()
    assert (precision < 25.0 * terms + 0.1).all()
    assert precision.std(dim=0).min() > 0.5


# One pixel, whose middle lies at the depth of 1 cm on the axis of the probe.
PROBE = LinearProbe(width_mm=2.0, near_mm=9.0, far_mm=11.0)
INTENSITIES = torch.tensor([0.2, 0.7], dtype=torch.float64)


def two_gaussians(weights, heights_cm):
    """Round, σ = 0.5 cm, above one another along elevation, at the depth of 0.95 cm."""
    gaussians = {
        "means": torch.tensor([[0.0, height, 0.95] for height in heights_cm]),
        "scales": torch.full((2, 3), math.log(0.5)),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2),
        "transmittances": torch.logit(torch.tensor(weights)),
        "sh0": (torch.logit(INTENSITIES) / (4.0 * 0.28209479177387814)).float().reshape(2, 1, 1),
    }
    return Field(gaussians, casts_shadow=False)


def one_pixel(field):
    with torch.no_grad():
        return weighted_sums(field.scene(np.zeros(3)), PROBE, np.eye(4)[None], 1, 1, "cpu")


def test_two_gaussians_on_one_pixel():
    field = two_gaussians((0.8, 0.3), (0.1, -0.4))
    # δ = (0, ∓height, 0.05) cm, A = 4 cm⁻²
    first = 0.8 * math.exp(-0.5 * 4.0 * (0.1**2 + 0.05**2))
    second = 0.3 * math.exp(-0.5 * 4.0 * (0.4**2 + 0.05**2))
    want = (first * 0.2 + second * 0.7 + 0.1 * 0.05) / (first + second + 0.1)
    got = average(*one_pixel(field), torch.tensor(0.1), torch.tensor(0.05))
    assert math.isclose(float(got), want, abs_tol=1e-6)


def test_the_shadow_is_the_sum_down_each_scan_line():
    weights = torch.tensor([[[1.0, 0.0], [2.0, 0.5], [0.0, 3.0]]])  # [1, 3, 2]
    got = shadow(weights, torch.tensor(0.5), 0.2)
    want = torch.exp(-0.5 * 0.2 * torch.tensor([[[1.0, 0.0], [3.0, 0.5], [3.0, 3.5]]]))
    assert torch.allclose(got, want, rtol=1e-6)


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


VARIANTS = ("ultragauss", "ultragauss-shadow")


def small_learner(dataset, variant, count=300):
    gaussians = even_start(dataset, count, torch.Generator().manual_seed(0))
    return UltraGaussLearner(dataset, 0, torch.device("cpu"), gaussians, casts_shadow=variant == "ultragauss-shadow")


def psnr_db(got, want):
    return float(-10.0 * np.log10(np.square(got - want).mean()))


@pytest.mark.long
@pytest.mark.parametrize("variant", VARIANTS)
def test_frames_are_learned_above_30_db(variant):
    dataset = make_tiny_dataset(frames=2, height=40, width=32)
    learner = small_learner(dataset, variant, count=600)
    for step in range(600):
        learner.take_step(step, 600)
    frames = learner.render(dataset.probe, dataset.train.poses, 40, 32)
    assert psnr_db(frames, dataset.train.images / 255.0) > 30.0


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_a_killed_fit_ends_in_the_model_of_an_undisturbed_one(variant, tmp_path, monkeypatch):
    """Killed between two resamplings, each of which finds Gaussians to replace."""
    monkeypatch.setattr("ultragray_studies.methods.ultragauss.LEAST_WEIGHT", 0.6)
    monkeypatch.setattr("ultragray.learn.training.geometry.MIN_GAUSSIANS", 300)
    dataset, method = make_tiny_dataset(frames=4, probe=CONVEX), METHODS[variant]
    budget, seen = steps_of(method, 420), []

    def note(progress):
        seen.append(progress.step)

    killed = FitRun(folder=tmp_path / "killed", report=note, should_stop=lambda: seen[-1] == 150)
    assert method.fit(dataset, budget, killed) is None
    resumed = method.fit(dataset, budget, FitRun(folder=tmp_path / "killed"))
    whole = method.fit(dataset, budget, FitRun(folder=tmp_path / "whole"))
    found_again = method.fit(dataset, budget, FitRun(folder=tmp_path / "killed"))
    poses = dataset.train.poses[:2]
    frames = [fitted.render(CONVEX, poses, 20, 16) for fitted in (resumed, whole, found_again) if fitted is not None]
    assert len(frames) == 3
    assert np.array_equal(frames[0], frames[1])
    assert np.array_equal(frames[0], frames[2])


def test_everything_learned_gets_a_gradient():
    learner = small_learner(make_tiny_dataset(frames=2), "ultragauss-shadow")
    learner.loss(0, 10).backward()
    for name, parameter in learner.module.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.any()), name


def test_the_shadow_begins_faint():
    """The first image's last row has an optical depth of 0.1 on average."""
    dataset = make_tiny_dataset(frames=2)
    plain, shadowed = (small_learner(dataset, variant) for variant in VARIANTS)
    pose = dataset.train.poses[0]
    with torch.no_grad():
        left = shadowed.frame(dataset.probe, pose, 20, 16) / plain.frame(dataset.probe, pose, 20, 16)
    assert abs(float(-left[-1].log().mean()) - 0.1) < 1e-4
    assert 0.99 < float(left[0].mean()) < 1.0


def test_images_smaller_than_the_window_of_ssim_are_refused():
    with pytest.raises(DatasetInvalid, match="at least 11 rows and columns, got 10x16"):
        small_learner(make_tiny_dataset(frames=2, height=10), "ultragauss")
