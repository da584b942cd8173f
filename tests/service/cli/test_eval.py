"""`ultragray eval` and `report`: from a folder of frames to figures, pictures and a page."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ultragray import ConvexProbe, GaussianScene, LinearProbe, Probe
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.released import read_released, write_released
from ultragray.learn.evaluation.scoring import evaluate, measure_reliability
from ultragray.learn.training import TrainingConfig, train

from .command_line import refused, run


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in the released layout: a ball in noise, 7 training and 2 held-out frames."""
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 1, 3] = np.linspace(-4.0, 4.0, 9)
    x, z = np.meshgrid(np.linspace(-1, 1, 16), np.linspace(0, 1, 20))
    ball = 140.0 * np.exp(-(x**2 + (z - 0.4) ** 2) / 0.1) + 50.0
    images = np.clip(ball + np.random.default_rng(0).normal(0.0, 4.0, (9, 20, 16)), 0, 255).astype(np.uint8)
    sweep = Sweep(images, poses, LinearProbe(20.0, 0.0, 25.0), np.arange(9), "ball")
    folder = tmp_path_factory.mktemp("sweeps") / "ball"
    write_released(Dataset("ball", sweep.select([0, 1, 3, 4, 5, 7, 8]), sweep.select([2, 6])), folder)
    return folder


@pytest.fixture(scope="module")
def scene(dataset: Path) -> Path:
    config = TrainingConfig.preset("fast", steps=5, max_gaussians=60)
    train(read_released(dataset), config).save(dataset.parent / "ball.ugr")
    return dataset.parent / "ball.ugr"


def printed_json(*arguments: object) -> Any:
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def test_eval_prints_what_the_library_measures(dataset: Path, scene: Path) -> None:
    expected = evaluate(GaussianScene.load(scene), read_released(dataset).val)
    reliability = measure_reliability(GaussianScene.load(scene), read_released(dataset).val)
    assert reliability is not None
    document = printed_json("eval", scene, dataset, "--json")
    figures = {**expected.to_dict(), "uncertainty": json.loads(json.dumps(reliability.to_dict()))}
    assert document == {"scene": str(scene), "dataset": "ball", "split": "val", **figures}
    result = run("eval", scene, dataset)
    assert result.exit_code == 0
    mean, std = expected.mean, expected.std
    assert f"{mean.psnr_db:.2f} ± {std.psnr_db:.2f}" in result.stdout
    assert f"{mean.gmsd:.3f} ± {std.gmsd:.3f}" in result.stdout
    assert "1 of its 5 scales" in result.stdout
    assert f"{expected.speckle.histogram_distance:.4f}" in result.stdout
    assert "true frames" in result.stdout
    assert f"{reliability.within_2:.0%} within 2 deviations" in " ".join(result.stdout.split())


def test_eval_of_the_training_frames_and_of_others(dataset: Path, scene: Path) -> None:
    train_part = printed_json("eval", scene, dataset, "--json", "--split", "train")
    assert train_part["split"] == "train"
    assert len(train_part["frames"]) == 7
    assert len(printed_json("eval", scene, dataset, "--json", "--val-frames", "0:3")["frames"]) == 3


def test_eval_writes_pictures(dataset: Path, scene: Path, tmp_path: Path) -> None:
    result = run("eval", scene, dataset, "-o", tmp_path / "pictures", "--json")
    assert result.exit_code == 0
    assert len(json.loads(result.stdout)["frames"]) == 2
    assert len(list((tmp_path / "pictures").glob("frame_*.png"))) == 2
    assert (tmp_path / "pictures" / "uncertainty.svg").read_text().startswith("<svg")


def test_report_of_a_scene(dataset: Path, scene: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    result = run("report", dataset, "-o", page, "--scene", scene, "--no-ablations", "--threads", 1)
    assert result.exit_code == 0, result.output
    assert result.stdout == f"wrote {page}\n"
    mean = evaluate(GaussianScene.load(scene), read_released(dataset).val).mean
    assert f"{mean.psnr_db:.2f} ±" in page.read_text()
    assert "Ablations" not in page.read_text()


def test_a_scene_of_another_probe_or_of_other_data(dataset: Path, scene: Path, tmp_path: Path) -> None:
    result = run("eval", scene, dataset, "--json", "--val-frames", "0:3")
    assert "warning: the scene was trained from other data than ball, or from another split of it" in result.stderr
    assert run("eval", scene, dataset, "--json").stderr == ""
    read = read_released(dataset)

    def written(name: str, probe: Probe) -> Path:
        parts = (replace(part, probe=probe) for part in (read.train, read.val))
        write_released(Dataset(name, *parts), tmp_path / name)
        return tmp_path / name

    wide = run("eval", scene, written("wide", LinearProbe(30.0, 0.0, 25.0)), "--json")
    assert "warning: the scene was trained with a linear probe (width 20 mm" in wide.stderr
    convex = written("convex", ConvexProbe(60.0, 10.0, 35.0))
    reported = ("report", convex, "-o", tmp_path / "page.html", "--scene", scene, "--no-ablations")
    for arguments in (("eval", scene, convex), reported):
        result = run(*arguments)
        assert result.exit_code == 2
        assert "error: convex: its probe is convex, the scene was trained with a linear one" in result.stderr


def test_a_dataset_without_held_out_frames_is_refused(dataset: Path, scene: Path, tmp_path: Path) -> None:
    sweep = read_released(dataset).train
    write_released(Dataset("alone", sweep, sweep.select([])), tmp_path / "alone")
    for arguments in (
        ("eval", scene, tmp_path / "alone"),
        ("compare", tmp_path / "alone"),
        ("report", tmp_path / "alone", "-o", tmp_path / "page.html"),
    ):
        assert "no frames to measure with" in refused(*arguments)
