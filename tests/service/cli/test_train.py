"""`ultragray train`: from a folder of frames to a scene file, with every way that a run may be stopped."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from typer.testing import CliRunner, Result

from ultragray import GaussianScene, LinearProbe
from ultragray.datasets.source import load_dataset
from ultragray.installation import install_advice
from ultragray.learn.training import TrainingConfig, trainer
from ultragray.learn.training.geometry import Geometry
from ultragray_service.cli.app import app

from ...waiting import Deadline

SMALL = ("--steps", 24, "--max-gaussians", 60, "--threads", 1)


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """A folder in the released layout: a ball in noise, 9 training and 2 held-out frames."""
    folder = tmp_path / "sweep"
    folder.mkdir()
    rng = np.random.default_rng(0)
    x, z = np.meshgrid(np.linspace(-1, 1, 16), np.linspace(0, 1, 20))
    ball = 140.0 * np.exp(-(x**2 + (z - 0.4) ** 2) / 0.1) + 50.0
    for part, count in (("train", 9), ("val", 2)):
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, 1, 3] = np.linspace(-4.0, 4.0, count) + 0.1
        np.save(folder / f"poses_{part}.npy", poses)
        images = np.clip(ball + rng.normal(0.0, 4.0, (count, 20, 16)), 0, 255).astype(np.uint8)
        np.save(folder / f"images_{part}.npy", images)
    keys = {"ultrasound_near_plane": 0.0, "ultrasound_far_plane": 2.5, "ultrasound_opening_width": 2.0}
    files = {f"{kind}_file_{part}": f"{kind}_{part}.npy" for kind in ("images", "poses") for part in ("train", "val")}
    (folder / "conf.json").write_text(json.dumps({**files, **keys}))
    return folder


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["train", *map(str, arguments)])


def refused(*arguments: object) -> str:
    """The one line that a mistake gives."""
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    errors = [line for line in result.stderr.splitlines() if not line.startswith("step ")]
    assert len(errors) == 1
    assert errors[0].startswith("error: ")
    return errors[0]


def test_trains_a_scene(dataset: Path, tmp_path: Path) -> None:
    output = tmp_path / "scene.ugr"
    result = run(dataset, "-o", output, *SMALL)
    assert result.exit_code == 0, result.output
    scene = GaussianScene.load(output)
    assert scene.gaussian_count == 60
    assert scene.info.probe == LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=25.0)
    assert scene.info.training["step"] == 24
    assert f"{scene.info.metrics['psnr_db']:.2f}" in result.stdout
    assert re.search(rf"wrote {output}: 60 Gaussians, 24 steps, \d+ s \(\d+\.\d ms a step\)\n", result.stdout)
    assert sum(line.startswith("step ") for line in result.stderr.splitlines()) == 10
    folder = tmp_path / "scene.ugr.run"
    assert sorted(path.name for path in folder.iterdir() if path.suffix != ".png") == ["config.json", "metrics.jsonl"]
    pictures = sorted(path.name for path in folder.glob("*.png"))
    assert pictures[0] == "validation_00000002.png"
    assert pictures[-2:] == ["validation_00000024.png", "validation_truth.png"]
    assert len((folder / "metrics.jsonl").read_text().splitlines()) == 24
    assert "the run is finished, all 24 steps are done" in refused(dataset, "-o", output, "--resume")


def test_settings_come_from_file_set_and_options(dataset: Path, tmp_path: Path) -> None:
    """What stands nearer to the command goes first: options, --set, the file, the preset."""
    file = tmp_path / "run.toml"
    file.write_text('preset = "paper"\nsteps = 3\nmax_gaussians = 40\nmeans_rate = 3e-4\nquats_rate = 1e-3\n')
    settings = ("--config", file, "--set", "steps=2", "--set", "quats_rate=2e-3", "--set", "start=informed")
    options = ("--seed", 5, "--steps", 1, "--no-transmittance", "--out-of-plane", 0, "--intensity", "sigmoid")
    result = run(dataset, "-o", tmp_path / "scene.ugr", *settings, *options)
    assert result.exit_code == 0, result.output
    training = GaussianScene.load(tmp_path / "scene.ugr").info.training
    assert training.pop("step") == 1
    expected = TrainingConfig.preset(
        "paper",
        steps=1,
        max_gaussians=40,
        means_rate=3e-4,
        quats_rate=2e-3,
        start="informed",
        seed=5,
        transmittance=False,
        out_of_plane_mm=0,
        intensity="sigmoid",
    )
    assert TrainingConfig.from_dict(training) == expected.resolved(Geometry.of(load_dataset(dataset)))
    assert run(dataset, "-o", tmp_path / "b.ugr", "--config", file, "--preset", "fast").exit_code == 0
    assert GaussianScene.load(tmp_path / "b.ugr").info.training["intensity"] == TrainingConfig().intensity


def test_a_training_that_cannot_fit_into_its_memory_is_refused(dataset: Path, tmp_path: Path) -> None:
    told = refused(dataset, "-o", tmp_path / "scene.ugr", *SMALL, "--set", "memory_gb=0.01")
    assert "GiB: lower max_gaussians" in told
    assert not (tmp_path / "scene.ugr.run").exists()


@pytest.mark.parametrize("options", [("--device", "cuda"), ("--backend", "cuda"), ("--device", "cuda:7")])
def test_says_what_is_missing_without_a_gpu(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, str]
) -> None:
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    told = refused(dataset, "-o", tmp_path / "scene.ugr", *SMALL, *options)
    assert "backend cuda needs an NVIDIA GPU and torch's CUDA build, but" in told
    assert not (tmp_path / "scene.ugr.run").exists()


def test_running_out_of_memory_leaves_the_last_good_scene(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    true_loss, calls = trainer.image_loss, 0

    def loss_that_runs_out(rendered: torch.Tensor, truth: torch.Tensor, texture: float) -> Any:
        nonlocal calls
        calls += 1
        if calls == 6:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return true_loss(rendered, truth, texture)

    monkeypatch.setattr(trainer, "image_loss", loss_that_runs_out)
    output = tmp_path / "scene.ugr"
    told = refused(dataset, "-o", output, *SMALL, "--checkpoint-every", 0)
    assert "did not suffice after step 5 with 60 Gaussians" in told
    assert f"lower max_gaussians or batch_size; the last good checkpoint is kept in {output}.run" in told
    assert f"{output} is the scene after step 5" in told
    assert GaussianScene.load(output).info.training["step"] == 5
    assert run(dataset, "-o", output, "--resume").exit_code == 0


def start(*arguments: object) -> subprocess.Popen[str]:
    program = f"import sys; sys.path[:0] = {sys.path!r}; from ultragray_service.cli.app import app; app()"
    command = [sys.executable, "-c", program, "train", *map(str, arguments)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})


def wait_for_lines(path: Path, count: int, process: subprocess.Popen[str]) -> None:
    deadline = Deadline(60)
    while not path.exists() or path.read_bytes().count(b"\n") < count:
        assert process.poll() is None, "the training ended early"
        assert not deadline.passed
        time.sleep(0.002)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_run_leaves_a_scene_and_goes_on(dataset: Path, tmp_path: Path, number: signal.Signals) -> None:
    output, small = tmp_path / "scene.ugr", ("--steps", 300, "--max-gaussians", 60, "--threads", 1)
    process = start(dataset, "-o", output, *small)
    wait_for_lines(tmp_path / "scene.ugr.run" / "metrics.jsonl", 5, process)
    process.send_signal(number)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    stopped_at = GaussianScene.load(output).info.training["step"]
    assert 5 <= stopped_at < 300
    assert f"stopped after step {stopped_at} of 300; wrote {output} as it is" in told
    assert "unfinished run: --resume continues it, --force begins anew" in refused(dataset, "-o", output, *small)
    assert "steps is 300 there, 50 here" in refused(dataset, "-o", output, "--resume", "--steps", 50)
    resumed = run(dataset, "-o", output, "--resume")  # the settings are those of the run
    assert resumed.exit_code == 0, resumed.output
    assert run(dataset, "-o", tmp_path / "undisturbed.ugr", *small).exit_code == 0
    assert output.read_bytes() == (tmp_path / "undisturbed.ugr").read_bytes()


@pytest.mark.long
def test_further_signals_do_not_stop_the_scene_from_being_written(dataset: Path, tmp_path: Path) -> None:
    output = tmp_path / "scene.ugr"
    process = start(dataset, "-o", output, "--steps", 3000, "--max-gaussians", 60, "--threads", 1)
    wait_for_lines(tmp_path / "scene.ugr.run" / "metrics.jsonl", 5, process)
    while process.poll() is None:  # until the interpreter itself has ended
        for number in (signal.SIGINT, signal.SIGTERM):
            process.send_signal(number)
        time.sleep(0.003)
    assert process.stderr is not None
    told = process.stderr.read()
    process.stderr.close()
    assert process.returncode == 130, told
    assert "Traceback" not in told
    assert GaussianScene.load(output).info.training["step"] < 3000


def test_tensorboard_that_is_missing_is_said(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    told = refused(dataset, "-o", tmp_path / "scene.ugr", *SMALL, "--tensorboard")
    assert f"TensorBoard is not installed: {install_advice('tensorboard')}" in told
    assert not (tmp_path / "scene.ugr.run").exists()
