"""What `make results`, `methods` and `ablations` measure, and the tables that come of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.learn.evaluation.methods import ComparisonSettings

from ..scripts import benchmark

results, methods, ablations = map(benchmark, ("results_tables", "methods_tables", "ablations"))
SETTINGS = {"steps": 3, "max_gaussians": 40}


def test_a_training_is_measured_beside_classical_methods(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_the_phantom_is_measured_in_the_shadow_of_bone(monkeypatch: pytest.MonkeyPatch) -> None:
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 1, 3] = range(4)
    images = np.random.default_rng(0).integers(100, 200, (4, 24, 24), dtype=np.uint8)
    sweep = Sweep(images, poses, LinearProbe(60.0, 0.0, 60.0), np.arange(4), "phantom")
    dataset = Dataset("phantom", sweep.select([0, 1, 3]), sweep.select([2]))
    monkeypatch.setattr(results, "load_dataset", lambda source, options: dataset)
    monkeypatch.setattr(results, "RUNS", {"phantom": results.Run(results.PHANTOM, settings=SETTINGS)})
    figures = results.measure("phantom", Path())
    shadow = figures["shadow"]
    assert 0.0 < shadow["median_mae"] < 0.4  # noise against the median of three times noise
    assert 0.0 < shadow["scene_mae"] < 0.8
    assert 0.0 <= shadow["scene_transmittance"] <= 1.0
    text = "\n".join(results.results({"phantom": figures}))
    assert f"{shadow['scene_mae']:.4f} (scene) against {shadow['median_mae']:.4f} (median compounding)" in text
    del figures["shadow"]
    assert "Where bone" not in "\n".join(results.results({"phantom": figures}))


def test_parts_leave_out_two_of_three_frames_or_a_band(data: Path) -> None:
    dataset = load_dataset(data / "ball", SourceOptions("0:5", "5:6"))
    third = results.part_of(dataset, results.Part.THIRD)
    assert [third.train.frame_numbers.tolist(), third.val.frame_numbers.tolist()] == [[0, 3], [1, 2, 4]]
    long = replace(dataset, train=dataset.train.select(np.resize(np.arange(5), 30)))
    band = results.part_of(long, results.Part.BAND)
    assert len(band.val) == 9, "ten spacings between the frames that are left"
    assert len(band.train) == 21


def test_each_run_is_compared_with_the_better_baseline() -> None:
    means = {
        "scene": {"psnr_db": 30.0, "ms_ssim": 0.9, "gms": 0.9, "gmsd": 0.10},
        "median": {"psnr_db": 29.0, "ms_ssim": 0.95, "gms": 0.8, "gmsd": 0.08},
        "linear": {"psnr_db": 29.5, "ms_ssim": 0.8, "gms": 0.7, "gmsd": 0.12},
    }
    run = {"metrics": {name: {"mean": mean} for name, mean in means.items()}}
    assert list(results._leads(run)) == ["+0.50", "-0.050", "+0.100", "-0.020"]


def test_methods_are_compared_and_what_failed_is_a_row_with_its_reason(
    data: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
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


def test_an_ablation_says_its_spread() -> None:
    runs = {f"ball, as it is, seed {seed}": {"psnr_db": 30.0 + seed, "ms_ssim": 0.9} for seed in ablations.SEEDS}
    lines = list(ablations.trained_without(runs))
    assert "| as it is | 31.00 ± 0.82 / 0.900 ± 0.000 |" in lines
    assert "| no absorption | – |" in lines
