"""train(): it learns, it repeats itself bit for bit, and nothing that stops it loses the work."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from ultragray import GaussianScene
from ultragray.errors import (
    BackendUnavailable,
    DatasetInvalid,
    InvalidArgument,
    MemoryExceeded,
    TrainingDiverged,
    TrainingStateInvalid,
)
from ultragray.learn.training import batch, train, trainer
from ultragray.learn.training.geometry import Geometry
from ultragray.learn.training.run import scene_of_checkpoint
from ultragray.scene import info as scene_info
from ultragray.scene.gaussians import LARGEST

from ..conftest import make_tiny_config, make_tiny_dataset


def learned(dataset, config, **options):
    seen = []
    return train(dataset, config, report=seen.append, **options), seen


def test_learns(tiny_dataset, tiny_config):
    _, seen = learned(tiny_dataset(), tiny_config(steps=80, refinements=0))
    first, last = (sum(progress.loss for progress in some) for some in (seen[:8], seen[-8:]))
    assert last < 0.8 * first


def test_reports_every_step(tiny_dataset, tiny_config):
    scene, seen = learned(tiny_dataset(), tiny_config())
    assert [progress.step for progress in seen] == list(range(1, 25))
    assert {progress.steps for progress in seen} == {24}
    assert seen[-1].seconds_left == 0
    assert seen[-1].val_psnr_db == pytest.approx(scene.info.metrics["psnr_db"], abs=1e-4)
    assert [progress.gaussian_count for progress in seen[::4]] == [30, 40, 50, 50, 60, 60]
    assert scene.gaussian_count == 60


def test_scene_says_what_it_is(tiny_dataset, tiny_config, tmp_path):
    dataset, config = tiny_dataset(), tiny_config()
    scene, _ = learned(dataset, config)
    scene.save(tmp_path / "scene.ugr")
    info = GaussianScene.load(tmp_path / "scene.ugr").info
    assert info.probe == dataset.probe
    assert (info.image_height, info.image_width) == (20, 16)
    assert info.centre_mm == pytest.approx(Geometry.of(dataset).centre_mm.tolist())
    assert (info.dataset_name, info.dataset_sha256) == ("tiny", dataset.sha256)
    assert (info.intensity, info.sh_degree) == ("sigmoid", 1)
    assert info.training == {**config.resolved(Geometry.of(dataset)).to_dict(), "step": 24}
    assert set(info.metrics) == {"psnr_db", "ms_ssim", "gms", "gmsd"}
    assert np.array_equal(scene.training_poses, dataset.train.poses)


def test_resumed_run_ends_in_the_same_scene(tiny_dataset, tiny_config, tmp_path):
    """Stopped at every third step, which is before, at and after refinements and rounds of frames."""
    dataset, config = tiny_dataset(), tiny_config(steps=12, confidence=True)
    expected = train(dataset, config)
    count = 0

    def every_third():
        nonlocal count
        count += 1
        return count % 3 == 0

    scene = train(dataset, config, folder=tmp_path, should_stop=every_third)
    assert scene.info.training["step"] == 3
    while scene.info.training["step"] < 12:
        scene = train(dataset, config, folder=tmp_path, resume=True, should_stop=every_third)
    assert scene.info.confidence == {}  # it was stopped once more, after the last step
    scene = train(dataset, config, folder=tmp_path, resume=True)
    assert scene.to_bytes() == expected.to_bytes()
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == list(range(1, 13))
    assert json.loads((tmp_path / "config.json").read_text()) == config.resolved(Geometry.of(dataset)).to_dict()


PROGRAM = """
import sys; sys.path[:0] = {path!r}
import importlib.util, os, pathlib, signal, torch
spec = importlib.util.spec_from_file_location("tiny", {conftest!r})
tiny = importlib.util.module_from_spec(spec); spec.loader.exec_module(tiny)
from ultragray.learn.training import train
torch.set_num_threads(1)
def report(progress):
    if progress.step == {last}:
        os.kill(os.getpid(), signal.SIGKILL)
folder = pathlib.Path({folder!r})
train(tiny.make_tiny_dataset(), tiny.make_tiny_config(), folder=folder, checkpoint_interval_s=0.0, report=report)
"""


@pytest.mark.slow
def test_killed_run_that_is_resumed_ends_in_the_same_scene(tiny_dataset, tiny_config, tmp_path):
    conftest, last = str(Path(__file__).parents[1] / "conftest.py"), random.randint(2, 18)
    program = PROGRAM.format(path=sys.path, conftest=conftest, folder=str(tmp_path), last=last)
    process = subprocess.run([sys.executable, "-c", program], env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert process.returncode == -signal.SIGKILL
    seen = []
    scene = train(tiny_dataset(), tiny_config(), folder=tmp_path, resume=True, report=seen.append)
    assert seen[0].step >= last  # it went on rather than began again
    assert scene.to_bytes() == train(tiny_dataset(), tiny_config()).to_bytes()
    lines = [json.loads(line)["step"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert lines == list(range(1, 25))


def test_folder_of_another_run_is_refused(tiny_dataset, tiny_config, tmp_path):
    dataset, config = tiny_dataset(), tiny_config()
    with pytest.raises(TrainingStateInvalid, match="no such file: there is nothing to resume"):
        train(dataset, config, folder=tmp_path, resume=True)
    train(dataset, config, folder=tmp_path, should_stop=lambda: True)
    with pytest.raises(TrainingStateInvalid, match="there is an unfinished run: resume it, or remove"):
        train(dataset, config, folder=tmp_path)
    with pytest.raises(TrainingStateInvalid, match="seed is 0 there, 5 here"):
        train(dataset, replace(config, seed=5), folder=tmp_path, resume=True)
    with pytest.raises(TrainingStateInvalid, match="another dataset"):
        train(tiny_dataset(spacing_mm=0.9), config, folder=tmp_path, resume=True)


@pytest.fixture(scope="module")
def stopped_run(tmp_path_factory):
    """The folder of a run that was stopped after two steps."""
    folder, stop = tmp_path_factory.mktemp("stopped"), iter([False, True])
    train(make_tiny_dataset(), make_tiny_config(), folder=folder, should_stop=lambda: next(stop))
    return folder


def spoilt(path, **changed):
    """The checkpoint with some tensors changed, or left out where they are None; `__` stands for a dot."""
    with safe_open(path, framework="pt") as bundle:
        metadata = bundle.metadata()
        tensors = {name: bundle.get_tensor(name) for name in bundle.keys()}  # noqa: SIM118
    tensors |= {name.replace("__", "."): tensor for name, tensor in changed.items()}
    save_file({name: tensor for name, tensor in tensors.items() if tensor is not None}, path, metadata)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"adam__means__exp_avg": torch.zeros(5, 3)}, r"adam\.means\.exp_avg is torch\.float32 \[5, 3\], expected"),
        (
            {"adam__sh0__exp_avg_sq": torch.zeros(30, 1)},
            r"adam\.sh0\.exp_avg_sq is .*\[30, 1\], expected .*\[30, 1, 1\]",
        ),
        ({"adam__quats__step": torch.tensor(7.0)}, r"adam\.quats\.step is 7, expected 2"),
        ({"adam__colours__step": torch.tensor(2.0)}, r"missing or unexpected tensors: adam\.colours\.step"),
        ({"parameter__means": torch.zeros(30, 3).double()}, r"parameter\.means is torch\.float64"),
        ({"parameter__means": torch.zeros(61, 3)}, r"it holds 61 Gaussians, expected 1 to 60"),
        ({"parameter__quats": torch.ones(29, 4)}, r"parameter\.quats is torch\.float32 \[29, 4\]"),
        ({"parameter__scales": torch.full((30, 3), float("nan"))}, r"parameter\.scales is not finite"),
        ({"waiting": torch.tensor([999])}, r"waiting names frames that the 8 do not have"),
        ({"waiting": torch.zeros(8, dtype=torch.int64)}, r"waiting names frames"),
        ({"generator": torch.full((5056,), 255, dtype=torch.uint8)}, r"generator is no generator's state"),
    ],
)
def test_a_checkpoint_with_other_tensors_is_refused(tiny_dataset, tiny_config, stopped_run, tmp_path, changed, reason):
    shutil.copytree(stopped_run, tmp_path, dirs_exist_ok=True)
    spoilt(tmp_path / "checkpoint.safetensors", **changed)
    with pytest.raises(TrainingStateInvalid, match=rf"checkpoint\.safetensors: .*{reason}"):
        train(tiny_dataset(), tiny_config(), folder=tmp_path, resume=True)


def test_divergence_keeps_the_last_good_checkpoint(tiny_dataset, tiny_config, tmp_path, monkeypatch):
    true_loss, calls = batch.image_loss, 0

    def loss_that_breaks(rendered, truth, *settings):
        nonlocal calls
        calls += 1
        return true_loss(rendered, truth, *settings) * (float("nan") if calls == 6 else 1.0)

    monkeypatch.setattr(batch, "image_loss", loss_that_breaks)
    with pytest.raises(TrainingDiverged, match="in step 6: the loss is nan; the last good checkpoint is kept"):
        train(tiny_dataset(), tiny_config(), folder=tmp_path, checkpoint_interval_s=0.0)
    scene = scene_of_checkpoint(tiny_dataset(), tmp_path)
    assert scene.info.training["step"] == 5


@pytest.mark.parametrize("error", [torch.OutOfMemoryError("CUDA out of memory."), MemoryExceeded("no room")])
def test_running_out_of_memory_keeps_the_last_good_checkpoint(tiny_dataset, tiny_config, tmp_path, monkeypatch, error):
    true_render, calls = trainer.render, 0

    def render_that_runs_out(*given, **options):
        nonlocal calls
        calls += 1
        if calls == 6:
            raise error
        return true_render(*given, **options)

    monkeypatch.setattr(trainer, "render", render_that_runs_out)
    config = tiny_config(refinements=0)
    told = (
        r"the memory of cpu did not suffice after step 4 with 60 Gaussians and batches of 3 frames of 20x16: lower "
        r"max_gaussians or batch_size; the last good checkpoint is kept in .*checkpoint\.safetensors"
    )  # the validations after steps 2 and 4 render too
    with pytest.raises(MemoryExceeded, match=told):
        train(tiny_dataset(), config, folder=tmp_path, checkpoint_interval_s=0.0)
    scene = train(tiny_dataset(), config, folder=tmp_path, resume=True)
    assert scene.to_bytes() == train(tiny_dataset(), config).to_bytes()


def test_a_step_reads_back_once(tiny_dataset, tiny_config, monkeypatch):
    """Each time that a number is asked for, a GPU is waited for."""
    asked = []

    def watch(name):
        true = getattr(torch.Tensor, name)
        monkeypatch.setattr(torch.Tensor, name, lambda *given: (asked.append(name), true(*given))[1])

    config = tiny_config(out_of_plane_mm=0)
    first = trainer.Trainer(tiny_dataset(), config, folder=None, device="cpu", backend="auto")
    for name in ("tolist", "item", "cpu", "nonzero", "__float__", "__int__", "__bool__", "__index__"):
        watch(name)
    first.take_step()
    assert asked == ["tolist"]


def test_parameters_that_are_not_finite_never_reach_a_checkpoint(tiny_dataset, tiny_config, tmp_path, monkeypatch):
    def spoil(sh0, intensity, floor):
        sh0[3] = float("inf")

    monkeypatch.setattr(trainer, "project_sh0", spoil)
    with pytest.raises(TrainingDiverged, match="in step 1: sh0 are no longer finite"):
        train(tiny_dataset(), tiny_config(), folder=tmp_path, checkpoint_interval_s=0.0)
    assert not (tmp_path / "checkpoint.safetensors").exists()


@pytest.mark.parametrize(
    ("part", "what"), [("refinement", "pose corrections \\(numbers\\)"), ("_beam", "numbers of the beam \\(numbers\\)")]
)
def test_neither_do_corrections_that_are_not_finite(tiny_dataset, tiny_config, tmp_path, monkeypatch, part, what):
    run = trainer.Trainer(tiny_dataset(), tiny_config(), folder=tmp_path, device="cpu", backend="auto")
    monkeypatch.setattr(getattr(run, part), "tensors", lambda: {"numbers": torch.tensor([1.0, float("nan")])})
    with pytest.raises(TrainingDiverged, match=f"{what} are no longer finite"):
        run.save_checkpoint()
    assert not (tmp_path / "checkpoint.safetensors").exists()


def test_gaussians_that_shrank_out_of_sight_do_not_end_a_training(tiny_dataset, tiny_config, tmp_path):
    run = trainer.Trainer(tiny_dataset(), tiny_config(), folder=tmp_path, device="cpu", backend="auto")
    with torch.no_grad():
        run.parameters["scales"][:3] = -25.0
    run.scene().save(tmp_path / "scene.ugr")
    assert bool((GaussianScene.load(tmp_path / "scene.ugr").scales[:3] == -LARGEST["scales"]).all())
    with torch.no_grad():
        run.parameters["scales"][3] = float("nan")
    with pytest.raises(InvalidArgument, match="Gaussian 3"):
        run.scene()


def test_harmonics_are_learned_once_they_join(tiny_dataset, tiny_config):
    late = train(tiny_dataset(), tiny_config(sh_start=1.0))
    assert bool((late.shN == 0).all())
    assert bool((train(tiny_dataset(), tiny_config()).shN != 0).any())
    assert train(tiny_dataset(), tiny_config(sh_degree=0)).sh_degree == 0


def test_released_intensities_stay_where_they_have_a_gradient(tiny_dataset, tiny_config):
    scene = train(tiny_dataset(), tiny_config(intensity="released", sh0_rate=0.5))
    value = 0.28209479 * scene.sh0 + 1.0
    assert 0.5 < float(value.min()) < 0.51
    assert float(value.max()) < 0.999


def test_refuses_what_cannot_be_trained(tiny_dataset, tiny_config):
    with pytest.raises(DatasetInvalid, match="images must have at least 11 rows and columns, got 10x16"):
        train(tiny_dataset(height=10), tiny_config())
    with pytest.raises(BackendUnavailable, match="device must be cpu, cuda or cuda:N, got 'warp'"):
        train(tiny_dataset(), tiny_config(), device="warp")


def test_refuses_more_frames_than_a_scene_can_name(tiny_dataset, tiny_config, monkeypatch):
    monkeypatch.setattr(scene_info, "MAX_TRAINING_POSES", 2)
    reported = []
    with pytest.raises(InvalidArgument, match="training_poses must be at most 2"):
        train(tiny_dataset(), tiny_config(), report=reported.append)
    assert not reported


def test_no_room_to_begin_is_said(tiny_dataset, tiny_config, tmp_path, monkeypatch):
    def no_room(*given):
        raise torch.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr(trainer, "initial_parameters", no_room)
    with pytest.raises(MemoryExceeded, match="the memory of cpu did not suffice for the Gaussians and the frames: low"):
        train(tiny_dataset(), tiny_config(), folder=tmp_path / "run")
    assert not (tmp_path / "run").exists()
