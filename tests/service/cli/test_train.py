"""`ultragray train`, `eval`, `report` and `compare`: a scene, figures and pages of frames; what is stopped goes on."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, GaussianScene, LinearProbe
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.released import read_released, write_released
from ultragray.datasets.source import load_dataset
from ultragray.installation import install_advice
from ultragray.learn.evaluation.baselines import evaluate_baselines
from ultragray.learn.evaluation.scoring import evaluate, measure_reliability
from ultragray.learn.training import TrainingConfig, batch, train
from ultragray.learn.training.geometry import Geometry

from ...waiting import Deadline
from .command_line import refused, run, succeeded

SMALL = ("--steps", 24, "--max-gaussians", 60, "--threads", 1)


def refused_run(*arguments):
    """The one line that a mistake gives."""
    result = run("train", *arguments)
    assert result.exit_code == 2, result.output
    errors = [line for line in result.stderr.splitlines() if not line.startswith("step ")]
    assert len(errors) == 1
    assert errors[0].startswith("error: ")
    return errors[0]


def test_trains_a_scene(dataset, tmp_path):
    output = tmp_path / "scene.ugr"
    result = succeeded("train", dataset, "-o", output, *SMALL)
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
    assert "the run is finished, all 24 steps are done" in refused_run(dataset, "-o", output, "--resume")


def test_settings_come_from_file_set_and_options(dataset, tmp_path):
    """What stands nearer to the command goes first: options, --set, the file, the preset."""
    file = tmp_path / "run.toml"
    file.write_text('preset = "paper"\nsteps = 3\nmax_gaussians = 40\nmeans_rate = 3e-4\nquats_rate = 1e-3\n')
    settings = ("--config", file, "--set", "steps=2", "--set", "quats_rate=2e-3", "--set", "start=informed")
    options = ("--seed", 5, "--steps", 1, "--no-transmittance", "--out-of-plane", 0, "--intensity", "sigmoid")
    succeeded("train", dataset, "-o", tmp_path / "scene.ugr", *settings, *options)
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
    succeeded("train", dataset, "-o", tmp_path / "b.ugr", "--config", file, "--preset", "fast")
    assert GaussianScene.load(tmp_path / "b.ugr").info.training["intensity"] == TrainingConfig().intensity


def test_a_training_that_cannot_fit_into_its_memory_is_refused(dataset, tmp_path):
    told = refused_run(dataset, "-o", tmp_path / "scene.ugr", *SMALL, "--set", "memory_gb=0.01")
    assert "GiB: lower max_gaussians" in told
    assert not (tmp_path / "scene.ugr.run").exists()


@pytest.mark.parametrize("options", [("--device", "cuda"), ("--backend", "cuda"), ("--device", "cuda:7")])
def test_says_what_is_missing_without_a_gpu(dataset, tmp_path, monkeypatch, options):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    told = refused_run(dataset, "-o", tmp_path / "scene.ugr", *SMALL, *options)
    assert "backend cuda needs an NVIDIA GPU and torch's CUDA build, but" in told
    assert not (tmp_path / "scene.ugr.run").exists()


def test_running_out_of_memory_leaves_the_last_good_scene(dataset, tmp_path, monkeypatch):
    true_loss, calls = batch.image_loss, 0

    def loss_that_runs_out(rendered, truth, *settings):
        nonlocal calls
        calls += 1
        if calls == 6:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return true_loss(rendered, truth, *settings)

    monkeypatch.setattr(batch, "image_loss", loss_that_runs_out)
    output = tmp_path / "scene.ugr"
    told = refused_run(dataset, "-o", output, *SMALL, "--checkpoint-every", 0)
    assert "did not suffice after step 5 with 60 Gaussians" in told
    assert f"lower max_gaussians or batch_size; the last good checkpoint is kept in {output}.run" in told
    assert f"{output} is the scene after step 5" in told
    assert GaussianScene.load(output).info.training["step"] == 5
    succeeded("train", dataset, "-o", output, "--resume")


SIGNALLED = """
import os
from ultragray.learn.training import batch
true_loss, calls = batch.image_loss, []
def loss(*arguments):
    calls.append(None)
    if len(calls) == 6:
        os.kill(os.getpid(), {number})
    return true_loss(*arguments)
batch.image_loss = loss
"""


def start(*arguments, before=""):
    program = f"import sys; sys.path[:0] = {sys.path!r}\n{before}\nfrom ultragray_service.cli.app import app; app()"
    command = [sys.executable, "-c", program, "train", *map(str, arguments)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})


def wait_for_lines(path, count, process):
    deadline = Deadline(60)
    while not path.exists() or path.read_bytes().count(b"\n") < count:
        assert process.poll() is None, "the training ended early"
        assert not deadline.passed
        time.sleep(0.002)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_run_leaves_a_scene_and_goes_on(dataset, tmp_path, number):
    output, small = tmp_path / "scene.ugr", ("--steps", 12, "--max-gaussians", 60, "--threads", 1)
    process = start(dataset, "-o", output, *small, before=SIGNALLED.format(number=int(number)))
    _, told = process.communicate(timeout=300)
    assert process.returncode == 130
    stopped_at = GaussianScene.load(output).info.training["step"]
    assert 5 <= stopped_at < 12
    assert f"stopped after step {stopped_at} of 12; wrote {output} as it is" in told
    assert "unfinished run: --resume continues it, --force begins anew" in refused_run(dataset, "-o", output, *small)
    assert "steps is 12 there, 50 here" in refused_run(dataset, "-o", output, "--resume", "--steps", 50)
    succeeded("train", dataset, "-o", output, "--resume")  # the settings are those of the run
    succeeded("train", dataset, "-o", tmp_path / "undisturbed.ugr", *small)
    assert output.read_bytes() == (tmp_path / "undisturbed.ugr").read_bytes()


@pytest.mark.long
def test_further_signals_do_not_stop_the_scene_from_being_written(dataset, tmp_path):
    output = tmp_path / "scene.ugr"
    process = start(dataset, "-o", output, "--steps", 3000, "--max-gaussians", 60, "--threads", 1)
    wait_for_lines(tmp_path / "scene.ugr.run" / "metrics.jsonl", 5, process)
    while process.poll() is None:  # until the interpreter itself has ended
        for number in (signal.SIGINT, signal.SIGTERM):
            process.send_signal(number)
        time.sleep(0.003)
    told = process.stderr.read()
    process.stderr.close()
    assert process.returncode == 130, told
    assert "Traceback" not in told
    assert GaussianScene.load(output).info.training["step"] < 3000


def test_tensorboard_that_is_missing_is_said(dataset, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    told = refused_run(dataset, "-o", tmp_path / "scene.ugr", *SMALL, "--tensorboard")
    assert f"tensorboardX is not installed: {install_advice('tensorboard')}" in told
    assert not (tmp_path / "scene.ugr.run").exists()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
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
def scene(dataset):
    config = TrainingConfig.preset("fast", steps=5, max_gaussians=60)
    train(read_released(dataset), config).save(dataset.parent / "ball.ugr")
    return dataset.parent / "ball.ugr"


def printed_json(*arguments):
    result = succeeded(*arguments)
    return json.loads(result.stdout)


def test_eval_prints_what_the_library_measures(dataset, scene):
    expected = evaluate(GaussianScene.load(scene), read_released(dataset).val)
    reliability = measure_reliability(GaussianScene.load(scene), read_released(dataset).val)
    document = printed_json("eval", scene, dataset, "--json")
    figures = {**expected.to_dict(), "uncertainty": json.loads(json.dumps(reliability.to_dict()))}
    means = {"mean": expected.mean.to_dict(), "std": expected.std.to_dict()}
    held_out = {"as_given": means, "on_path": None, "registered": None}
    assert document == {"scene": str(scene), "dataset": "ball", "split": "val", **figures, "held_out": held_out}
    assert "is for held-out frames" in refused("eval", scene, dataset, "--split", "train", "--register")
    result = succeeded("eval", scene, dataset)
    mean, std = expected.mean, expected.std
    assert f"{mean.psnr_db:.2f} ± {std.psnr_db:.2f}" in result.stdout
    assert f"{mean.gmsd:.3f} ± {std.gmsd:.3f}" in result.stdout
    assert "1 of its 5 scales" in result.stdout
    assert f"{expected.speckle.histogram_distance:.4f}" in result.stdout
    assert "true frames" in result.stdout
    assert f"{reliability.within_2:.0%} within 2 deviations" in " ".join(result.stdout.split())


def test_eval_writes_pictures(dataset, scene, tmp_path):
    result = succeeded("eval", scene, dataset, "-o", tmp_path / "pictures", "--json")
    assert len(json.loads(result.stdout)["frames"]) == 2
    assert len(list((tmp_path / "pictures").glob("frame_*.png"))) == 2
    assert (tmp_path / "pictures" / "uncertainty.svg").read_text().startswith("<svg")


def test_report_of_a_scene(dataset, scene, tmp_path):
    page = tmp_path / "page.html"
    result = succeeded("report", dataset, "-o", page, "--scene", scene, "--no-ablations", "--threads", 1)
    assert result.stdout == f"wrote {page}\n"
    mean = evaluate(GaussianScene.load(scene), read_released(dataset).val).mean
    assert f"{mean.psnr_db:.2f} ±" in page.read_text()
    assert "Ablations" not in page.read_text()


def test_a_scene_of_another_probe_or_of_other_data(dataset, scene, tmp_path):
    result = run("eval", scene, dataset, "--json", "--val-frames", "0:3")
    assert "warning: the scene was trained from other data than ball, or from another split of it" in result.stderr
    assert run("eval", scene, dataset, "--json").stderr == ""
    read = read_released(dataset)

    def written(name, probe):
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


def test_a_dataset_without_held_out_frames_is_refused(dataset, scene, tmp_path):
    sweep = read_released(dataset).train
    write_released(Dataset("alone", sweep, sweep.select([])), tmp_path / "alone")
    for arguments in (
        ("eval", scene, tmp_path / "alone"),
        ("compare", tmp_path / "alone"),
        ("report", tmp_path / "alone", "-o", tmp_path / "page.html"),
    ):
        assert "no frames to measure with" in refused(*arguments)


CLASSICAL = ("--methods", "median,linear,nearest")


def test_the_table_has_what_the_library_measures(dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    expected = evaluate_baselines(read_released(dataset), ("median", "linear", "nearest"))
    result = succeeded("compare", dataset, *CLASSICAL)
    assert "ball, 2 val frames" in result.stdout
    for title, name in {"median compounding, 0.5 mm": "median", "linear between frames": "linear"}.items():
        mean = expected[name].mean
        figures = rf"{mean.psnr_db:.2f} +{mean.ms_ssim:.3f} +{mean.gms:.3f} +{mean.gmsd:.3f}"
        assert re.search(rf"{title} +{figures} +– +\d+\.\d +\d+\.\d +\d+\.\d\d +\d\.\d\d\n", result.stdout), (
            result.stdout
        )
    assert list(tmp_path.iterdir()) == []


def test_a_page_with_its_table_as_json_and_latex(dataset, tmp_path):
    page = tmp_path / "ball.html"
    result = succeeded("compare", dataset, *CLASSICAL, "-o", page)
    assert "linear between frames" in page.read_text()
    assert len(json.loads((tmp_path / "ball.json").read_text())["results"]) == 3
    assert r"\toprule" in (tmp_path / "ball.tex").read_text()
    assert f"wrote {page}\n" in result.stdout


def test_a_comparison_over_seeds_has_error_bars(dataset, tmp_path):
    page = tmp_path / "ball.html"
    line = ("compare", dataset, "--methods", "linear,nearest", "--seeds", 2, "--seed", 7, "-o", page)
    result = succeeded(*line)
    assert "2 seeds from 7" in result.stdout
    assert re.search(r"linear between frames +\d+\.\d\d ± 0\.00 +\d\.\d{3} ± 0\.000", result.stdout)
    document = json.loads((tmp_path / "ball.json").read_text())
    assert [one["seed"] for one in document["seeds"]] == [7, 8]
    means = [one["results"][0]["evaluation"]["mean"]["psnr_db"] for one in document["seeds"]]
    assert document["over_seeds"]["linear between frames"]["psnr_db"]["mean"] == pytest.approx(np.mean(means))
    assert (tmp_path / "ball.svg").read_text().startswith("<svg")
    succeeded(*line)
    means = json.loads(run(*line[:-2], "--json").stdout)["over_seeds"]
    assert means == document["over_seeds"]


def test_a_comparison_of_which_nothing_could_be_measured_ends_with_an_error(tmp_path):
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 1, 3] = [0.0, 10_000.0, 20_000.0, 30_000.0]  # mm: no volume of voxels holds that
    poses[:, 0, 3] = [0.0, 9_000.0, -9_000.0, 18_000.0]
    images = np.random.default_rng(0).integers(0, 255, (4, 16, 16), dtype=np.uint8)
    frames = Sweep(images, poses, LinearProbe(20.0, 0.0, 25.0), np.arange(4), "wide")
    write_released(Dataset("wide", frames.select([0, 1, 3]), frames.select([2])), tmp_path / "wide")
    result = run("compare", tmp_path / "wide", "--methods", "median-0.25mm")
    assert result.exit_code == 1
    assert "voxel" in result.stdout
    succeeded("compare", tmp_path / "wide", "--methods", "median-0.25mm,nearest")


def test_what_is_not_a_comparisons_is_not_replaced(dataset, tmp_path):
    page = tmp_path / "ball.html"
    (tmp_path / "ball.tex").write_text("a paper")
    assert f"{tmp_path / 'ball.tex'} exists: --force replaces it" in refused("compare", dataset, *CLASSICAL, "-o", page)
    (tmp_path / "ball.tex").unlink()
    (tmp_path / "ball.html.run").mkdir()
    (tmp_path / "ball.html.run" / "thesis.txt").write_text("all of it")
    assert "holds no comparison" in refused("compare", dataset, *CLASSICAL, "-o", page, "--force")
    assert (tmp_path / "ball.html.run" / "thesis.txt").exists()
    assert "output must end in .html" in refused("compare", dataset, *CLASSICAL, "-o", tmp_path / "ball.pdf")
