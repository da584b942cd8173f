"""The confidence that a training ends with: fitted on frames it left out, the same every time, and true of others."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from ultragray import GaussianScene
from ultragray.errors import TrainingDiverged
from ultragray.learn.evaluation.scoring import evaluate, render_sweep
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.training import TrainingConfig, run, train
from ultragray.learn.training.confidence import fit_confidence, shorter
from ultragray.learn.training.geometry import Geometry
from ultragray.phantom import PHANTOM_PROBE, freehand_poses, simulate
from ultragray.scene.confidence import VARIANCE_TERMS, Assessor, ConfidenceModel

SIDE = 64


def simulated(poses):
    images = simulate(poses, probe=PHANTOM_PROBE, height=SIDE, width=SIDE)
    return Sweep(images, poses, PHANTOM_PROBE, np.arange(len(poses)), "phantom")


@lru_cache
def phantom() -> tuple[Dataset, Sweep]:
    """A straight sweep with a gap and without its last third, and frames in the gap, tilted, and off the end."""
    poses = freehand_poses(46)
    along = poses[:, 1, 3]
    train_poses = poses[(along < 18.0) & ~((along > -14.0) & (along < -7.0))]
    others = freehand_poses(120, tilt_deg=6.0, unrest=1.0)[::8], freehand_poses(120, unrest=2.0)[4::8]
    val = np.concatenate(others)
    dataset = Dataset("phantom", simulated(train_poses), simulated(val))
    return dataset, dataset.val


@lru_cache
def trained() -> GaussianScene:
    dataset, _ = phantom()
    return train(dataset, TrainingConfig.preset("fast", steps=120, max_gaussians=4_000))


def ranks(values):
    return values.argsort().argsort().astype(np.float64)


def told_and_actual():
    scene, (_, val) = trained(), phantom()
    actual = np.array([frame.ms_ssim for frame in evaluate(scene, val).frames])
    told = np.array([frame.confidence for frame in Assessor(scene.info, scene.training_poses).assess(val.poses)])
    return told, actual


@pytest.mark.long
def test_frames_that_will_reach_more_are_told_more():
    told, actual = told_and_actual()
    assert actual.std() > 0.1
    assert np.corrcoef(ranks(told), ranks(actual))[0, 1] > 0.8


@pytest.mark.long
def test_it_tells_what_frames_will_reach():
    told, actual = told_and_actual()
    assert np.abs(told - actual).mean() < 0.1


@pytest.mark.long
def test_the_same_training_ends_in_the_same_scene():
    dataset, _ = phantom()
    again = train(dataset, TrainingConfig.preset("fast", steps=120, max_gaussians=4_000))
    assert again.to_bytes() == trained().to_bytes()
    model = ConfidenceModel.from_dict(trained().info.confidence)
    assert len(model.hardness) == len(dataset.train)
    assert 10 <= model.fitted_on < 0.5 * len(dataset.train)
    assert 0.0 < model.error < 0.15


def test_nothing_of_what_is_left_out_is_trained_from(tiny_dataset):
    dataset, parts = tiny_dataset(frames=40), []

    def train_part(part):
        parts.append(part)
        return train(part, TrainingConfig.preset("fast", steps=5, max_gaussians=50, confidence=False))

    model = fit_confidence(dataset, train_part, backend="auto")
    (part,) = parts
    assert len(part.train) + model.fitted_on == len(dataset.train)
    assert set(part.train.frame_numbers) < set(dataset.train.frame_numbers)
    assert len(part.val) == 0


@pytest.mark.parametrize(("steps", "fewer_steps"), [(1_001, 251), (400, 150), (24, 24)])
def test_a_quarter_of_the_steps_and_fewer_gaussians(tiny_dataset, tiny_config, steps, fewer_steps):
    config = tiny_config(steps=steps).resolved(Geometry.of(tiny_dataset()))
    fewer = shorter(config, 0.6)
    assert (fewer.steps, fewer.max_gaussians, fewer.initial_gaussians) == (fewer_steps, 36, 18)
    assert fewer.out_of_plane_mm == config.out_of_plane_mm


@pytest.mark.long
def test_it_can_be_left_out(tiny_dataset, tiny_config):
    dataset = tiny_dataset(frames=40)
    without = train(dataset, tiny_config())
    assert without.info.confidence == {}
    having = train(dataset, tiny_config(confidence=True))
    assert having.info.confidence["version"] == 2
    assert len(having.info.confidence["uncertainty"]["variances"]) == len(VARIANCE_TERMS)
    assert having.means.equal(without.means)


@pytest.mark.long
def test_the_time_left_holds_the_fit_and_the_fit_is_told(tiny_dataset, tiny_config):
    seen = []
    train(tiny_dataset(frames=40), tiny_config(confidence=True), report=seen.append)
    own = [progress for progress in seen if progress.beside is None]
    fit = [progress for progress in seen if progress.beside == run.FITTING]
    assert seen == own + fit
    assert fit[-1].step == fit[-1].steps > 0
    steps_left = [progress.seconds_left * progress.steps_per_s for progress in own]
    later = steps_left[-1]
    assert 0.5 * fit[-1].steps <= later <= fit[-1].steps
    assert steps_left == pytest.approx([own[-1].steps - progress.step + later for progress in own])


def test_too_few_frames_give_none(tiny_dataset, tiny_config):
    assert train(tiny_dataset(frames=6), tiny_config(confidence=True)).info.confidence == {}


def test_a_stop_while_it_is_calibrated_leaves_the_scene(tiny_dataset, tiny_config):
    asked = 0

    def after_the_last_step():
        nonlocal asked
        asked += 1
        return asked > 24 + 3

    scene = train(tiny_dataset(frames=40), tiny_config(confidence=True), should_stop=after_the_last_step)
    assert asked == 24 + 4
    assert scene.info.training["step"] == 24
    assert scene.info.confidence == {}


def test_a_calibration_that_diverges_costs_no_scene(tiny_dataset, tiny_config, monkeypatch, caplog):
    def diverge(*_, **__):
        raise TrainingDiverged("training diverged in step 3: the loss is nan")

    monkeypatch.setattr(run, "fit_confidence", diverge)
    scene = train(tiny_dataset(frames=40), tiny_config(confidence=True))
    assert scene.info.confidence == {}
    assert "the scene gets no confidence: training diverged in step 3" in caplog.text


@pytest.mark.long
def test_it_tells_the_errors_of_pixels():
    scene, (_, val) = trained(), phantom()
    bmode, uncertainty = (render_sweep(scene, val, output=output) for output in ("bmode", "uncertainty"))
    errors = np.abs(val.images / 255.0 - bmode)
    assert 0.5 < np.sqrt((uncertainty**2).mean()) / np.sqrt((errors**2).mean()) < 2.0
    sure, unsure = (errors[chosen].mean() for chosen in (uncertainty < 0.1, uncertainty > 0.2))
    assert unsure > 2.0 * sure
    assert 0.85 < (errors <= 2.0 * uncertainty).mean() < 0.995
