"""What `make results` runs: figures kept run by run, tables written from them."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.released import write_released
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid
from ultragray.training.config import VIEWS_BETWEEN
from ultragray.training.data.geometry import Geometry

SCRIPT = Path(__file__).resolve().parents[1] / "benchmarks" / "results_tables.py"
SETTINGS = {"steps": 3, "max_gaussians": 40}


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    spec = importlib.util.spec_from_file_location("results_tables", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
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


@pytest.fixture
def data(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 1, 3] = range(8)
    images = rng.integers(0, 200, (8, 16, 14), dtype=np.uint8)
    sweep = Sweep(images, poses, LinearProbe(20.0, 0.0, 25.0), np.arange(8), "ball")
    write_released(Dataset("ball", sweep.select(range(6)), sweep.select([6, 7])), tmp_path / "ball")
    return tmp_path


def run(script: ModuleType, monkeypatch: pytest.MonkeyPatch, data: Path, *arguments: str) -> None:
    files = ("--figures", str(data / "figures.json"), "--tables", str(data / "results.md"))
    monkeypatch.setattr(sys, "argv", ["results_tables.py", str(data), *files, *arguments])
    script.main()


def test_runs_are_kept_one_by_one_and_tabled_together(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, data: Path
) -> None:
    run(script, monkeypatch, data, "--only", "two")
    first = json.loads((data / "figures.json").read_text())
    assert list(first) == ["two"]
    assert first["two"]["split"] == {"train": "0:3", "val": "3:6"}
    run(script, monkeypatch, data, "--only", "one")
    figures = json.loads((data / "figures.json").read_text())
    assert figures["two"] == first["two"]
    assert figures["one"]["train_frames"] == 6
    assert figures["one"]["gaussians"] > 0
    assert figures["one"]["steps"] == 3
    assert figures["one"]["total_s"] == pytest.approx(0.003 * figures["one"]["step_ms"])
    tables = (data / "results.md").read_text()
    assert tables == script.tables(figures)
    assert tables.index("## one") < tables.index("## two")
    mean = figures["one"]["metrics"]["scene"]["mean"]
    assert f"{mean['psnr_db']:.2f}" in tables
    assert "Training frames 0:3, held out 3:6" in tables
    assert tables.count("| nearest training frame |") == 2


def test_a_run_tells_the_steps_that_the_data_decided(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, data: Path
) -> None:
    monkeypatch.setattr(script, "RUNS", (script.Run("default", "ball", options=SourceOptions("0:2", "3:4")),))
    run(script, monkeypatch, data)
    dataset = load_dataset(data / "ball", SourceOptions("0:2", "3:4"))
    steps = Geometry.of(dataset).steps(VIEWS_BETWEEN)
    assert json.loads((data / "figures.json").read_text())["default"]["steps"] == steps
    assert f"| default | 2 / 1 | 16x14 | fast | {steps:,} |" in (data / "results.md").read_text()


def test_a_run_that_fails_loses_nothing(script: ModuleType, monkeypatch: pytest.MonkeyPatch, data: Path) -> None:
    with pytest.raises(DatasetInvalid, match="none"):
        run(script, monkeypatch, data)
    assert set(json.loads((data / "figures.json").read_text())) == {"one", "two"}
    assert "## two" in (data / "results.md").read_text()


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
    tables = script.tables({"phantom": figures})
    assert f"{shadow['scene_mae']:.4f} (scene) against {shadow['median_mae']:.4f} (median compounding)" in tables
    assert f"mean transmittance of the scene {shadow['scene_transmittance']:.3f}" in tables
    del figures["shadow"]
    assert "Where bone" not in script.tables({"phantom": figures})


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
    assert script._comparison({"one": run})[-2] == "| one | +0.50 | -0.050 | +0.100 | -0.020 |"


def test_the_readme_shows_the_runs_that_it_names(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, data: Path
) -> None:
    readme = data / "README.md"
    readme.write_text(f"before\n{script.README_BEGINS}\nold\n{script.README_ENDS}\nafter\n")
    monkeypatch.setattr(script, "README", readme)
    monkeypatch.setattr(script, "TABLES", data / "results.md")
    monkeypatch.setattr(script, "README_ROWS", {"two": "a ball, the other half"})
    run(script, monkeypatch, data, "--only", "two")
    figures = json.loads((data / "figures.json").read_text())["two"]
    before, begins, *rows, measured, ends, after = readme.read_text().splitlines()
    assert (before, begins, ends, after) == ("before", script.README_BEGINS, script.README_ENDS, "after")
    mean = figures["metrics"]["linear"]["mean"]
    assert f"| a ball, the other half | {figures['total_s']:.0f} s |" in rows[2]
    assert rows[2].endswith(f"{mean['psnr_db']:.1f} dB, {mean['ms_ssim']:.3f}, {mean['gmsd']:.3f} |")
    assert measured == f"Measured at commit {figures['commit']} on {figures['machine']}."


def test_an_ablation_says_its_spread(script: ModuleType, monkeypatch: pytest.MonkeyPatch, data: Path) -> None:
    ablations = script.ablations
    where = {"commit": "abc", "machine": "a machine"}
    runs = {f"as it is, seed {seed}": {"psnr_db": 30.0 + seed, "ms_ssim": 0.9, **where} for seed in ablations.SEEDS}
    (data / "ablations.json").write_text(json.dumps({"ball": runs}))
    monkeypatch.setattr(ablations, "FIGURES", data / "ablations.json")
    lines = list(ablations.section())
    assert "| as it is | 31.00 ± 0.82 / 0.900 ± 0.000 |" in lines
    assert "| no absorption | – |" in lines
    assert "Measured at commit abc on a machine." in lines
