"""What `make results` runs: figures kept run by run, tables written from them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from ultragray import LinearProbe
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid
from ultragray.learn.training.config import VIEWS_BETWEEN
from ultragray.learn.training.geometry import Geometry

from ..scripts import benchmark

SETTINGS = {"steps": 3, "max_gaussians": 40}


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module = benchmark("results_tables")
    monkeypatch.setattr(
        module,
        "RUNS",
        (
            module.Run("one", "ball", settings=SETTINGS),
            module.Run("two", "ball", options=SourceOptions("0:3", "3:6"), settings=SETTINGS),
            module.Run("missing", "none", settings=SETTINGS),
        ),
    )
    return module


def run(script: ModuleType, monkeypatch: pytest.MonkeyPatch, data: Path, *arguments: str) -> None:
    monkeypatch.setattr("sys.argv", ["results_tables.py", str(data), "--figures", str(figures_of(data)), *arguments])
    script.main()


def figures_of(data: Path) -> Path:
    return data / "new" / "figures.json"


def read(data: Path) -> dict[str, Any]:
    return dict(json.loads(figures_of(data).read_text()))


def test_runs_are_kept_one_by_one_and_tabled_together(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, data: Path
) -> None:
    run(script, monkeypatch, data, "--only", "two")
    first = read(data)
    assert list(first) == ["two"]
    assert first["two"]["split"] == {"train": "0:3", "val": "3:6"}
    run(script, monkeypatch, data, "--only", "one")
    figures = read(data)
    assert figures["two"] == first["two"]
    assert figures["one"]["train_frames"] == 6
    assert figures["one"]["gaussians"] > 0
    assert figures["one"]["steps"] == 3
    assert figures["one"]["total_s"] == pytest.approx(0.003 * figures["one"]["step_ms"])
    assert figures["one"]["measured"]["machine"]["threads"] == torch.get_num_threads()
    tables = "\n".join(script.tables(figures))
    assert tables.index("## one") < tables.index("## two")
    mean = figures["one"]["metrics"]["scene"]["mean"]
    assert f"{mean['psnr_db']:.2f}" in tables
    assert "Training frames 0:3, held out 3:6" in tables
    assert tables.count("| nearest training frame |") == 2


@pytest.mark.long
def test_a_run_tells_the_steps_that_the_data_decided(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, data: Path
) -> None:
    monkeypatch.setattr(script, "RUNS", (script.Run("default", "ball", options=SourceOptions("0:2", "3:4")),))
    run(script, monkeypatch, data)
    dataset = load_dataset(data / "ball", SourceOptions("0:2", "3:4"))
    steps = Geometry.of(dataset).steps(VIEWS_BETWEEN)
    assert read(data)["default"]["steps"] == steps
    assert f"| default | 2 / 1 | 16x14 | fast | {steps:,} |" in list(script.tables(read(data)))[2]


def test_a_run_that_fails_loses_nothing(script: ModuleType, monkeypatch: pytest.MonkeyPatch, data: Path) -> None:
    with pytest.raises(DatasetInvalid, match="none"):
        run(script, monkeypatch, data)
    assert set(read(data)) == {"one", "two"}


def test_the_phantom_is_measured_in_the_shadow_of_bone(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 1, 3] = range(4)
    images = np.random.default_rng(0).integers(100, 200, (4, 24, 24), dtype=np.uint8)
    sweep = Sweep(images, poses, LinearProbe(60.0, 0.0, 60.0), np.arange(4), "phantom")
    dataset = Dataset("phantom", sweep.select([0, 1, 3]), sweep.select([2]))
    monkeypatch.setattr(script, "load_dataset", lambda source, options: dataset)
    figures = script.measure(script.Run("phantom", script.PHANTOM, settings=SETTINGS), Path())
    shadow = figures["shadow"]
    assert 0.0 < shadow["median_mae"] < 0.4  # noise against the median of three times noise
    assert 0.0 < shadow["scene_mae"] < 0.8
    assert 0.0 <= shadow["scene_transmittance"] <= 1.0
    monkeypatch.setattr(script, "RUNS", (script.Run("phantom", script.PHANTOM),))
    tables = "\n".join(script.tables({"phantom": figures}))
    assert f"{shadow['scene_mae']:.4f} (scene) against {shadow['median_mae']:.4f} (median compounding)" in tables
    assert f"mean transmittance of the scene {shadow['scene_transmittance']:.3f}" in tables
    del figures["shadow"]
    assert "Where bone" not in "\n".join(script.tables({"phantom": figures}))


def test_parts_leave_out_two_of_three_frames_or_a_band(script: ModuleType, data: Path) -> None:
    dataset = load_dataset(data / "ball", SourceOptions("0:5", "5:6"))
    third = script.part_of(dataset, script.Part.THIRD)
    assert [third.train.frame_numbers.tolist(), third.val.frame_numbers.tolist()] == [[0, 3], [1, 2, 4]]
    long = replace(dataset, train=dataset.train.select(np.resize(np.arange(5), 30)))
    band = script.part_of(long, script.Part.BAND)
    assert len(band.val) == 9, "ten spacings between the frames that are left"
    assert len(band.train) == 21


def test_each_run_is_compared_with_the_better_baseline(script: ModuleType) -> None:
    means = {
        "scene": {"psnr_db": 30.0, "ms_ssim": 0.9, "gms": 0.9, "gmsd": 0.10},
        "median": {"psnr_db": 29.0, "ms_ssim": 0.95, "gms": 0.8, "gmsd": 0.08},
        "linear": {"psnr_db": 29.5, "ms_ssim": 0.8, "gms": 0.7, "gmsd": 0.12},
    }
    run = {"metrics": {name: {"mean": mean} for name, mean in means.items()}}
    assert list(script._comparison({"one": run}))[-2] == "| one | +0.50 | -0.050 | +0.100 | -0.020 |"


def test_the_readme_shows_the_runs_that_it_names(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, data: Path
) -> None:
    monkeypatch.setattr(script, "README_ROWS", {"two": "a ball, the other half"})
    run(script, monkeypatch, data, "--only", "one", "two")
    figures = script.glanced_at(read(data))
    assert list(figures) == ["two"]
    *_, row = script.at_a_glance(figures)
    mean = figures["two"]["metrics"]["linear"]["mean"]
    assert row.startswith(f"| a ball, the other half | {figures['two']['total_s']:.0f} s |")
    assert row.endswith(f"{mean['psnr_db']:.1f} dB, {mean['ms_ssim']:.3f}, {mean['gmsd']:.3f} |")


def test_an_ablation_says_its_spread() -> None:
    ablations = benchmark("ablations")
    runs = {f"as it is, seed {seed}": {"psnr_db": 30.0 + seed, "ms_ssim": 0.9} for seed in ablations.SEEDS}
    lines = list(ablations.tables({"ball": runs}))
    assert "| as it is | 31.00 ± 0.82 / 0.900 ± 0.000 |" in lines
    assert "| no absorption | – |" in lines


def test_an_ablation_is_not_repeated_at_its_commit() -> None:
    ablations = benchmark("ablations")
    assert ablations.is_of_commit({"measured": {"commit": "abc"}}, "abc")
    for of, here in (("abc", "def"), ("abc-dirty", "abc-dirty"), (None, None)):
        assert not ablations.is_of_commit({"measured": {"commit": of}}, here)
