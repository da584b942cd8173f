"""What a report measures: trainings, ablations that differ in one thing, and tilts that grow."""

from dataclasses import replace

import numpy as np
import pytest

from ultragray.errors import TrainingDiverged
from ultragray.learn.evaluation.scoring import evaluate
from ultragray.learn.training import Progress, TrainingConfig
from ultragray_studies import report as study
from ultragray_studies.report import (
    Failed,
    ablations,
    attempt,
    frame_tilts_deg,
    split_by_tilt,
    study_tilt,
    train_and_evaluate,
)


def test_a_training_is_followed_and_measured(turning_dataset, small_config):
    seen = []
    trained = train_and_evaluate(turning_dataset, small_config, report=seen.append)
    assert trained.course.losses == [progress.loss for progress in seen]
    assert len(trained.course.losses) == 6
    assert list(trained.course.val_psnr_db) == [1, 2, 3, 4, 5, 6]
    assert trained.evaluation.frames == evaluate(trained.scene, turning_dataset.val).frames
    assert trained.course.seconds == pytest.approx(6 * trained.course.step_s)


def test_each_validation_is_a_point_even_where_nothing_changed(
    turning_dataset, small_config, random_scene, monkeypatch
):
    def train(dataset, config, *, report):
        for step, val_step in ((1, None), (2, 2), (3, 2), (4, 4), (5, 4)):
            report(Progress(step, 5, 0.1, 7, 1.0, 1.0, None if val_step is None else 20.0, val_step))
        return random_scene(7)

    monkeypatch.setattr(study, "train", train)
    assert train_and_evaluate(turning_dataset, small_config).course.val_psnr_db == {2: 20.0, 4: 20.0}


def test_a_study_that_fails_gives_its_reason():
    def fail():
        raise TrainingDiverged("the loss is nan")

    assert attempt(fail) == Failed("the loss is nan")
    assert attempt(lambda: 3) == 3
    with pytest.raises(ZeroDivisionError):
        attempt(lambda: 1 // 0)


def test_ablations_differ_in_what_they_are_named_after(small_config):
    full = small_config.to_dict()
    changed = {
        name: {key: value for key, value in config.to_dict().items() if value != full[key]}
        for name, config in ablations(small_config, small_config.max_gaussians or 0).items()
    }
    assert changed == {
        "no transmittance": {"transmittance": False},
        "spherical harmonics of degree 0": {"sh_degree": 0},
        "no out-of-plane sampling": {"out_of_plane_mm": 0.0},
        "a quarter of the Gaussians": {"max_gaussians": 15},
        "half of the Gaussians": {"max_gaussians": 30},
        "twice the Gaussians": {"max_gaussians": 120},
    }


def test_a_share_of_the_gaussians_is_a_share_from_the_start():
    paper = TrainingConfig.preset("paper", initial_gaussians=300_000, max_gaussians=500_000)
    counts = {
        name: (config.initial_gaussians, config.max_gaussians)
        for name, config in ablations(paper, 440_000).items()
        if "of the Gaussians" in name or name.startswith("twice")
    }
    assert counts == {
        "a quarter of the Gaussians": (75_000, 110_000),
        "half of the Gaussians": (150_000, 220_000),
        "twice the Gaussians": (600_000, 880_000),
    }
    pruned = ablations(TrainingConfig.preset("paper"), 400_000)["half of the Gaussians"]
    assert (pruned.initial_gaussians, pruned.max_gaussians) == (200_000, 200_000)


def test_tilts_are_signed_angles_about_the_axis_of_turning(turning_dataset):
    tilts = frame_tilts_deg(turning_dataset.train)
    expected = np.linspace(-10, 10, 12)[turning_dataset.train.frame_numbers]
    expected -= expected.mean()
    np.testing.assert_allclose(tilts, expected, atol=0.05)
    backwards = turning_dataset.train.select(range(len(tilts))[::-1])
    np.testing.assert_allclose(frame_tilts_deg(backwards), -expected[::-1], atol=0.05)


def test_halves_of_the_tilts():
    low, high = split_by_tilt(np.array([5.0, -5.0, 4.0, -4.0, 0.0])) or ([], [])
    assert list(low) == [1, 3]
    assert list(high) == [0, 2, 4]
    assert split_by_tilt(np.array([0.0, 1.0, 2.0, 2.9])) is None
    assert split_by_tilt(np.array([0.0, 10.0, 20.0])) is None


def test_a_study_of_tilt_measures_what_was_not_trained_on(turning_dataset, small_config):
    tilt = study_tilt(turning_dataset.train, small_config)
    assert tilt.train_tilts_deg[1] < tilt.val_tilts_deg[0]
    assert set(tilt.evaluations) == {"scene", "median", "nearest"}
    between_frames = 20.0 / 11.0
    np.testing.assert_allclose(tilt.angles_deg, between_frames * np.array([2, 3, 4, 6, 7]), atol=1e-9)
    turned_back = turning_dataset.train.poses.copy()
    turned_back[:, :3, :3] = np.eye(3)
    assert study_tilt(replace(turning_dataset.train, poses=turned_back), small_config) is None
