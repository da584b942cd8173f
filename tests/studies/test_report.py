"""A report: what it measures, and its page, which is complete, self-contained, and safe with any name."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.datasets import Dataset, Sweep
from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray.learn.evaluation.scoring import evaluate
from ultragray.learn.training import TrainingConfig
from ultragray_studies import report as report_module
from ultragray_studies.comparison.result import MethodResult
from ultragray_studies.comparison.run import SCENE, compare_methods
from ultragray_studies.methods.gaussians import GivenScene, SceneMethod
from ultragray_studies.report import (
    Failed,
    ReportContent,
    ablation_methods,
    ablations,
    baselines,
    frame_tilts_deg,
    render_report,
    study_tilt,
    train_and_evaluate,
)

from ..model.learn.report.test_page import Checked

FRAMES, HEIGHT, WIDTH = 12, 20, 16
LARGEST_TILT_DEG = 10.0


@pytest.fixture(scope="module")
def turning_dataset():
    """A ball in noise under a probe that turns from −10° to +10° about its lateral axis; every fourth is held out."""
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    angles = np.radians(np.linspace(-LARGEST_TILT_DEG, LARGEST_TILT_DEG, FRAMES))
    for pose, angle in zip(poses, angles, strict=True):
        c, s = math.cos(angle), math.sin(angle)
        pose[1:3, 1:3] = [[c, -s], [s, c]]
    x, z = np.meshgrid(np.linspace(-1, 1, WIDTH), np.linspace(0, 1, HEIGHT))
    ball = 140.0 * np.exp(-((x - angles[:, None, None]) ** 2 + (z - 0.4) ** 2) / 0.1)
    noise = np.random.default_rng(0).normal(50.0, 4.0, (FRAMES, HEIGHT, WIDTH))
    images = np.clip(ball + noise, 0, 255).astype(np.uint8)
    sweep = Sweep(images, poses, LinearProbe(20.0, 0.0, 25.0), np.arange(FRAMES), "turning")
    held_out = np.arange(FRAMES) % 4 == 1
    return Dataset("turning <sweep>", sweep.select(np.flatnonzero(~held_out)), sweep.select(np.flatnonzero(held_out)))


@pytest.fixture(scope="module")
def small_config():
    return TrainingConfig.preset("fast", steps=6, max_gaussians=60, batch_size=3)


def test_a_training_is_followed_and_measured(turning_dataset, small_config):
    seen = []
    trained = train_and_evaluate(turning_dataset, small_config, report=seen.append)
    assert trained.course.losses == [progress.loss for progress in seen]
    assert len(trained.course.losses) == 6
    assert list(trained.course.val_psnr_db) == [1, 2, 3, 4, 5, 6]
    assert trained.evaluation.frames == evaluate(trained.scene, turning_dataset.val).frames
    assert trained.course.seconds == pytest.approx(6 * trained.course.step_s)


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


def test_a_study_of_tilt_measures_what_was_not_trained_on(turning_dataset, small_config):
    tilt = study_tilt(turning_dataset.train, small_config)
    assert tilt.train_tilts_deg[1] < tilt.val_tilts_deg[0]
    assert set(tilt.evaluations) == {"scene", "median", "nearest"}
    between_frames = 20.0 / 11.0
    np.testing.assert_allclose(tilt.angles_deg, between_frames * np.array([2, 3, 4, 6, 7]), atol=1e-9)
    turned_back = turning_dataset.train.poses.copy()
    turned_back[:, :3, :3] = np.eye(3)
    assert study_tilt(replace(turning_dataset.train, poses=turned_back), small_config) is None


@pytest.fixture(scope="module")
def content(turning_dataset, small_config, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    trained = train_and_evaluate(turning_dataset, small_config)
    ablated = ablation_methods(small_config, small_config.max_gaussians or 0)
    methods = {SCENE: GivenScene(trained.scene, trained.course.seconds), **baselines(0.5), **ablated}
    return ReportContent(
        dataset=turning_dataset,
        scene=trained.scene,
        comparison=compared(turning_dataset, methods, folder),
        folder=folder,
        course=trained.course,
        ablations=tuple(ablated),
        tilt=study_tilt(turning_dataset.train, small_config),
    )


def compared(dataset, methods, folder):
    found = compare_methods(dataset, methods, ComparisonSettings(), folder=folder)
    assert found is not None
    return found


def with_failures(content, reason, *names):
    """The same where these methods failed."""
    results = tuple(
        MethodResult(one.name, one.description, one.machine, failure=reason) if one.name in names else one
        for one in content.comparison.results
    )
    return replace(content, comparison=replace(content.comparison, results=results))


def test_the_page_is_whole_and_needs_nothing_else(content):
    text = render_report(content)
    Checked(text)
    assert text.count("<img ") == 3 * (1 + 2 + 2 + 6 * 2)  # truth, the scene, what it is made of, the baselines
    assert text.count("<svg ") == 5
    assert "turning &lt;sweep&gt;" in text
    assert "turning <sweep>" not in text
    for heading in ("Against the baselines", "Pictures", "Ablations", "Growing tilt", "Training"):
        assert f"<h2>{heading}</h2>" in text
    rows = re.findall(r'<th scope="row">(.*?)</th>', text)
    classical = [
        "median compounding, 0.5 mm",
        "mean compounding, 0.5 mm",
        "maximum compounding, 0.5 mm",
        "linear between frames",
        "nearest training frame",
        "neighbours in time",
    ]
    assert rows == [
        *("this scene", *classical),
        *("this scene", *classical),  # their ranks
        *("true frames", "this scene", *classical),
        *("full model", *content.ablations),
        *("scene", "median", "nearest"),
    ]
    mean = content.comparison.measured[SCENE].mean
    assert f"{mean.psnr_db:.2f} ±" in text
    assert f"{mean.gmsd:.3f} ±" in text


def of_rows(content, *names):
    results = tuple(one for one in content.comparison.results if one.name in names)
    return replace(content, comparison=replace(content.comparison, results=results))


def without_ablations(content):
    return replace(of_rows(content, *(one.name for one in content.compared)), ablations=())


def test_a_scene_from_a_file_without_ablations(content):
    text = render_report(replace(without_ablations(content), course=None, tilt=None))
    Checked(text)
    assert re.findall(r"<h2>(.*?)</h2>", text) == ["Against the baselines", "Pictures"]


def test_what_failed_says_why_in_place_of_its_figures(content):
    reason = "it needs 9 GB & more"
    text = render_report(
        replace(with_failures(content, reason, "linear", "half of the Gaussians"), tilt=Failed("<diverged>"))
    )
    Checked(text)
    for name, cells in (("linear between frames", 4), ("half of the Gaussians", 6)):
        assert f'<th scope="row">{name}</th><td class="failure" colspan="{cells}">it needs 9 GB &amp; more</td>' in text
    assert "This study could not be finished: &lt;diverged&gt;" in text
    assert "hardly turns" not in text


def test_the_plot_of_counts_holds_the_runs_that_differ_in_nothing_else(content, monkeypatch):
    plotted = []
    monkeypatch.setattr(report_module, "plot_counts", lambda points: plotted.extend(points) or "<svg></svg>")
    other = SceneMethod("opaque", "opaque", TrainingConfig(steps=1, max_gaussians=77, transmittance=False).to_dict())
    extra = compared(content.dataset, {"opaque": other}, content.folder)
    comparison = replace(content.comparison, results=(*content.comparison.results, *extra.results))
    report_module._counts_plot(replace(content, comparison=comparison, ablations=(*content.ablations, "opaque")))
    assert sorted(plotted) == [15, 30, 60, 120]
