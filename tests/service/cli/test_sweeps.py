"""`ultragray check`, `draw` and `convert`: real files in, a table, files and a picture out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from ultragray import LinearProbe, phantom
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.released import write_released
from ultragray.datasets.source import load_dataset
from ultragray_service.cli.app import app


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, 1, 3] = np.arange(12)
    images = np.random.default_rng(0).integers(0, 250, (12, 20, 16), dtype=np.uint8)
    sweep = Sweep(images, poses, LinearProbe(40, 0, 50), np.arange(12), "sweep")
    write_released(Dataset("tiny", sweep.select(range(10)), sweep.select([10, 11])), tmp_path / "tiny")
    return tmp_path / "tiny"


def test_check_prints_a_table_and_warnings(folder: Path) -> None:
    result = run("check", folder, "--train-frames", "0:4,8:10")
    assert result.exit_code == 0, result.output
    assert "tiny: linear probe (width 40 mm, near 0 mm, far 50 mm)" in result.output
    assert [line.split()[-2:] for line in result.output.splitlines() if line.startswith("frames ")] == [["6", "2"]]
    assert "held-out frames lie 1.50 mm (median) to 2.00 mm" in result.output
    assert "nothing suspicious" in result.output
    poses = np.load(folder / "poses_train.npy")
    poses[4, 0, 3] = 30.0
    np.save(folder / "poses_train.npy", poses)
    result = run("check", folder)
    assert result.exit_code == 0
    assert "warning: train: frame 4 lies 30.0 mm off" in result.output


def test_check_as_json(folder: Path) -> None:
    result = run("check", folder, "--json")
    document = json.loads(result.output)
    assert document["name"] == "tiny"
    assert document["sha256"] == load_dataset(folder).sha256
    assert document["train"]["step_median_mm"] == pytest.approx(1.0)
    assert document["val"]["frames"] == 2
    assert document["warnings"] == []


def test_bad_data_is_one_line_and_exit_code_two(folder: Path) -> None:
    images = np.load(folder / "images_train.npy")
    images[3] = 0
    np.save(folder / "images_train.npy", images)
    for command in (["check"], ["convert", "-o", folder.parent / "other"], ["draw", "-o", folder.parent / "a.png"]):
        result = run(command[0], folder, *command[1:])
        assert result.exit_code == 2
        assert result.stderr.startswith("error: ")
        assert "images_train.npy: frame 3 is constant" in result.stderr
        assert result.stderr.count("\n") == 1
    assert sorted(path.name for path in folder.parent.iterdir()) == ["tiny"]


def test_says_that_the_phantom_takes_time(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(phantom, "load_phantom", lambda: load_dataset(folder))
    result = run("check", "phantom", "--json")
    assert result.stderr == "simulating the phantom …\n"
    assert json.loads(result.stdout)["name"] == "tiny"
    assert run("check", folder).stderr == ""


def test_convert_writes_what_is_read_back(folder: Path) -> None:
    result = run("convert", folder, "-o", folder.parent / "half", "--image-size", "8x10", "--val-frames", "0:2")
    assert result.exit_code == 0, result.output
    assert "8 training and 2 held-out frames of 8x10" in result.output
    assert load_dataset(folder.parent / "half").train.images.shape == (8, 10, 8)
    again = run("convert", folder, "-o", folder.parent / "half")
    assert again.exit_code == 2
    assert f"new or empty folder, {folder.parent / 'half'} holds files" in again.stderr
    assert run("convert", folder, "-o", folder.parent / "half", "--force").exit_code == 0
    assert load_dataset(folder.parent / "half").sha256 == load_dataset(folder).sha256


def test_draw_draws_a_png(folder: Path) -> None:
    picture = folder.parent / "sweep.png"
    result = run("draw", folder, "-o", picture)
    assert result.exit_code == 0, result.output
    assert picture.read_bytes().startswith(b"\x89PNG")
    wrong = run("draw", folder, "-o", folder.parent / "sweep.jpg")
    assert wrong.exit_code == 2
    assert "output must end in .png, got 'sweep.jpg'" in wrong.stderr
