"""What `make results`, `methods` and `ablations` measure, and the tables that come of it."""

import numpy as np
import pytest
import torch

from ultragray.datasets.source import SourceOptions
from ultragray.learn.evaluation.baselines import evaluate_baselines
from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray.learn.sweep import Sweep
from ultragray.learn.training.agreement import with_shares
from ultragray.phantom.demo import demo_poses, load_demo_scene
from ultragray.rendering.frames import render

from ..model.learn.training.test_agreement import FRAMES, hand_path, recording
from ..model.learn.training.test_poses import PROBE
from ..scripts import benchmark

results, methods, ablations, localization = map(
    benchmark, ("results_tables", "methods_tables", "ablations", "localization")
)
SETTINGS = {"steps": 3, "max_gaussians": 40}


def test_a_training_is_measured_beside_classical_methods(data, monkeypatch):
    run = results.Run("ball", options=SourceOptions("0:3", "3:6"), settings=SETTINGS)
    monkeypatch.setattr(results, "RUNS", {"two": run})
    monkeypatch.setattr(results, "README_ROWS", {"two": "a ball, the other half"})
    figures = {"two": results.measure("two", data)}
    assert (figures["two"]["train_frames"], figures["two"]["steps"]) == (3, 3)
    assert figures["two"]["total_s"] == pytest.approx(0.003 * figures["two"]["step_ms"])
    text = "\n".join(results.results(figures))
    mean = figures["two"]["metrics"]["scene"]["mean"]
    assert f"{mean['psnr_db']:.2f}" in text
    assert "Training frames 0:3, held out 3:6" in text
    assert text.count("| nearest training frame |") == 1
    *_, row = results.results_at_a_glance(results.glanced_at({**figures, "other": {}}))
    assert row.startswith(f"| a ball, the other half | {figures['two']['total_s']:.0f} s |")


def test_scores_on_the_path_stand_beside_those_as_given(random_scene):
    tracked, scene = hand_path(), random_scene(info={"probe": PROBE})
    given = recording(with_shares(tracked, [range(FRAMES)], PROBE, (0.0, 0.0, 0.0)), tracked)
    found = results._on_path(scene, given)
    as_given = evaluate_baselines(given, ("linear",))["linear"]
    assert found["linear_on_path"].mean.psnr_db > as_given.mean.psnr_db + 1.0
    assert set(found) < set(results.ROW_NAMES)
    assert results._on_path(scene, recording(tracked, tracked)) == {}


def test_methods_are_compared_and_what_failed_is_a_row_with_its_reason(data, monkeypatch, tmp_path):
    classical = ComparisonSettings(methods=("median", "linear", "nearest"))
    monkeypatch.setattr(methods, "RUNS", {"one": ("ball", classical)})
    monkeypatch.setattr(methods, "FOLDER", tmp_path / "fits")
    one = methods.measure("one", data)
    assert list(one["methods"]) == ["median", "linear", "nearest"]
    assert methods.measure("one", data)["methods"] == one["methods"], "what was measured is not measured again"
    one["methods"]["other"] = {"title": "Other", "failure": "the loss is nan", "cost": {}}
    lines = list(methods.methods({"one": one}))
    assert lines[0] == "### one"
    psnr = one["methods"]["median"]["mean"]["psnr_db"]
    assert any(line.startswith("| median compounding") and f"{psnr:.2f}" in line for line in lines)
    assert any(line.startswith("| Other | failed: the loss is nan") for line in lines)


def test_frames_that_were_found_are_judged_by_the_true_poses_too():
    scene, true = load_demo_scene(), demo_poses(3)[1:2]
    bmode = render(scene, None, true, height=128, width=96, outputs=("bmode",))["bmode"].detach()
    recorded = true.copy()
    recorded[:, :3, 3] += 2.0 * true[:, :3, 1]  # mm across the image plane
    images = (255.0 * bmode).round().to(torch.uint8).numpy()
    sweep = Sweep(images, recorded, scene.info.probe_or(None), np.arange(1), "one frame")
    run = localization.row(localization.HeldOut(scene, sweep, true=true))
    assert (run["recorded"]["within"], run["on_path"], run["true"]["within"]) == (0.0, None, 1.0)
    assert 1.8 < run["recorded"]["median_mm"] < 2.2
    *_, row = localization.found_frames({"phantom": run})
    assert row.startswith("| phantom | 1 | 0%: ")
    assert "° |  | 100%: 0.0" in row
