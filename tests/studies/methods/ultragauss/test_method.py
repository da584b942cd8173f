"""Fits of UltraGauss: what they learn, and that an interrupted one is no other."""

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, LinearProbe
from ultragray.errors import DatasetInvalid
from ultragray.learn.sweep import Dataset, Sweep
from ultragray_studies.methods.method import FitRun
from ultragray_studies.methods.registry import METHODS
from ultragray_studies.methods.ultragauss import UltraGaussLearner, even_start

from ..volumes import steps_of

LINEAR = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=25.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=60.0)
VARIANTS = ("ultragauss", "ultragauss-shadow")


def ball(frames, height, width, probe=LINEAR):
    """A bright ball in grey noise, with a shadow below it, in frames 0.8 mm apart."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, 3] = (30.0, -20.0, 10.0)
    poses[:, 1, 3] += 0.8 * np.arange(frames)
    x, z = np.meshgrid(np.linspace(-1, 1, width), np.linspace(0, 1, height))
    y = np.linspace(-1, 1, frames)[:, None, None]
    bright = np.exp(-((x - 0.3 * y) ** 2 + (z - 0.4) ** 2 + 0.2 * y**2) / 0.1)
    noise = np.random.default_rng(0).normal(0.0, 4.0, (frames, height, width))
    images = np.clip((140.0 * bright + 60.0) * np.where((np.abs(x) < 0.3) & (z > 0.6), 0.3, 1.0) + noise, 0, 255)
    sweep = Sweep(images.astype(np.uint8), poses, probe, np.arange(frames), "ball")
    return Dataset("ball", sweep, sweep.select([]))


def small_learner(dataset, variant, count=300):
    gaussians = even_start(dataset, count, torch.Generator().manual_seed(0))
    return UltraGaussLearner(dataset, 0, torch.device("cpu"), gaussians, casts_shadow=variant == "ultragauss-shadow")


def psnr_db(got, want):
    return float(-10.0 * np.log10(np.square(got - want).mean()))


@pytest.mark.long
@pytest.mark.parametrize("variant", VARIANTS)
def test_frames_are_learned_above_30_db(variant):
    dataset = ball(2, 40, 32)
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
    dataset, method = ball(4, 20, 16, CONVEX), METHODS[variant]
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


def test_a_learner_takes_over_another_number_of_gaussians():
    dataset = ball(3, 20, 16)
    few, many = small_learner(dataset, "ultragauss", count=50), small_learner(dataset, "ultragauss", count=80)
    few.take_step(0, 10)
    many.load({name: tensor.clone() for name, tensor in few.state().items()})
    assert many.take_step(1, 10) == few.take_step(1, 10)
    assert all(torch.equal(tensor, few.model()[name]) for name, tensor in many.model().items())


def test_weights_that_vanish_are_resampled():
    dataset = ball(3, 20, 16)
    learner = small_learner(dataset, "ultragauss", count=120)
    with torch.no_grad():
        learner.module.gaussians["transmittances"][:30] = -8.0
    for step in range(98, 101):
        learner.take_step(step, 300)
    weights = learner.module.gaussians["transmittances"].detach().sigmoid()
    assert len(weights) == 120
    assert float(weights.min()) > 0.005


def test_everything_learned_gets_a_gradient():
    learner = small_learner(ball(2, 20, 16), "ultragauss-shadow")
    learner.loss(0, 10).backward()
    for name, parameter in learner.module.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.any()), name


def test_the_shadow_begins_faint():
    """The first image's last row has an optical depth of 0.1 on average."""
    dataset = ball(2, 20, 16)
    plain, shadowed = (small_learner(dataset, variant) for variant in VARIANTS)
    pose = dataset.train.poses[0]
    with torch.no_grad():
        left = shadowed.frame(LINEAR, pose, 20, 16) / plain.frame(LINEAR, pose, 20, 16)
    assert abs(float(-left[-1].log().mean()) - 0.1) < 1e-4
    assert 0.99 < float(left[0].mean()) < 1.0


def test_images_smaller_than_the_window_of_ssim_are_refused():
    with pytest.raises(DatasetInvalid, match="at least 11 rows and columns, got 10x16"):
        small_learner(ball(2, 10, 16), "ultragauss")
