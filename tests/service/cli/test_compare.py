"""`ultragray compare`: the table, the page, and a comparison that is stopped and goes on."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.released import read_released, write_released
from ultragray.learn.evaluation.baselines import evaluate_baselines
from ultragray.learn.training.trainer import JOURNAL_FILE

from ...waiting import Deadline
from .command_line import python, refused, run

CLASSICAL = ("--methods", "median,linear,nearest")


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in the released layout: a ball in noise, 7 training and 2 held-out frames."""
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 1, 3] = np.linspace(-4.0, 4.0, 9)
    x, z = np.meshgrid(np.linspace(-1, 1, 16), np.linspace(0, 1, 20))
    ball = 140.0 * np.exp(-(x**2 + (z - 0.4) ** 2) / 0.1) + 50.0
    images = np.clip(ball + np.random.default_rng(0).normal(0.0, 4.0, (9, 20, 16)), 0, 255).astype(np.uint8)
    frames = Sweep(images, poses, LinearProbe(20.0, 0.0, 25.0), np.arange(9), "ball")
    folder = tmp_path_factory.mktemp("sweeps") / "ball"
    write_released(Dataset("ball", frames.select([0, 1, 3, 4, 5, 7, 8]), frames.select([2, 6])), folder)
    return folder


def test_the_table_has_what_the_library_measures(sweep: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    expected = evaluate_baselines(read_released(sweep), ("median", "linear", "nearest"))
    result = run("compare", sweep, *CLASSICAL)
    assert result.exit_code == 0, result.output
    assert "ball, 2 val frames" in result.stdout
    for title, name in {"median compounding, 0.5 mm": "median", "linear between frames": "linear"}.items():
        mean = expected[name].mean
        figures = rf"{mean.psnr_db:.2f} +{mean.ms_ssim:.3f} +{mean.gms:.3f} +{mean.gmsd:.3f}"
        assert re.search(rf"{title} +{figures} +– +\d+\.\d +\d+\.\d +\d+\.\d\d +\d\.\d\d\n", result.stdout), (
            result.stdout
        )
    assert list(tmp_path.iterdir()) == []


def test_a_page_with_its_table_as_json_and_latex(sweep: Path, tmp_path: Path) -> None:
    page = tmp_path / "ball.html"
    result = run("compare", sweep, *CLASSICAL, "-o", page)
    assert result.exit_code == 0, result.output
    assert "linear between frames" in page.read_text()
    assert len(json.loads((tmp_path / "ball.json").read_text())["results"]) == 3
    assert r"\toprule" in (tmp_path / "ball.tex").read_text()
    assert f"wrote {page}\n" in result.stdout


def test_a_comparison_of_which_nothing_could_be_measured_ends_with_an_error(tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 1, 3] = [0.0, 10_000.0, 20_000.0, 30_000.0]  # mm: no volume of voxels holds that
    poses[:, 0, 3] = [0.0, 9_000.0, -9_000.0, 18_000.0]
    images = np.random.default_rng(0).integers(0, 255, (4, 16, 16), dtype=np.uint8)
    frames = Sweep(images, poses, LinearProbe(20.0, 0.0, 25.0), np.arange(4), "wide")
    write_released(Dataset("wide", frames.select([0, 1, 3]), frames.select([2])), tmp_path / "wide")
    result = run("compare", tmp_path / "wide", "--methods", "median-0.25mm")
    assert result.exit_code == 1
    assert "voxel" in result.stdout
    assert run("compare", tmp_path / "wide", "--methods", "median-0.25mm,nearest").exit_code == 0


def test_what_is_not_a_comparisons_is_not_replaced(sweep: Path, tmp_path: Path) -> None:
    page = tmp_path / "ball.html"
    (tmp_path / "ball.tex").write_text("a paper")
    assert f"{tmp_path / 'ball.tex'} exists: --force replaces it" in refused("compare", sweep, *CLASSICAL, "-o", page)
    (tmp_path / "ball.tex").unlink()
    (tmp_path / "ball.html.run").mkdir()
    (tmp_path / "ball.html.run" / "thesis.txt").write_text("all of it")
    assert "holds no comparison" in refused("compare", sweep, *CLASSICAL, "-o", page, "--force")
    assert (tmp_path / "ball.html.run" / "thesis.txt").exists()
    assert "output must end in .html" in refused("compare", sweep, *CLASSICAL, "-o", tmp_path / "ball.pdf")


@pytest.mark.long
def test_ctrl_c_stops_it_and_the_same_command_goes_on(sweep: Path, tmp_path: Path) -> None:
    page = tmp_path / "ball.html"
    arguments = ("compare", sweep, "--methods", "scene,nearest", "-o", page, "--threads", 1)
    program = "from ultragray_service.cli.app import app; app()"
    process = subprocess.Popen(
        python(program, *arguments), stderr=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    journal, deadline = tmp_path / "ball.html.run" / "scene" / JOURNAL_FILE, Deadline(60)
    while not journal.exists() or journal.read_bytes().count(b"\n") < 5:
        assert process.poll() is None, "the comparison ended early"
        assert not deadline.passed
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130, told
    stopped = re.search(
        r"^stopped at scene, method 1 of 2, after step ([\d,]+) of [\d,]+; go on with the same command$", told, re.M
    )
    assert stopped, told
    assert not page.exists()
    step = int(stopped[1].replace(",", ""))
    assert run(*arguments).exit_code == 0
    steps = [json.loads(line)["step"] for line in journal.read_text().splitlines()]
    assert steps == list(range(1, len(steps) + 1)), "steps were done twice"
    assert len(steps) > step
    assert "nearest training frame" in page.read_text()
