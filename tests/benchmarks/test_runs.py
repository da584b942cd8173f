"""What `make results`, `methods` and `ablations` measure, and the tables that come of it."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ultragray.datasets.source import SourceOptions
from ultragray.learn.evaluation.baselines import evaluate_baselines
from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray.learn.sweep import Sweep
from ultragray.learn.training import agreement
from ultragray.learn.training.agreement import with_shares
from ultragray.phantom.demo import demo_poses, load_demo_scene
from ultragray.rendering.frames import render

from ..model.learn.training.test_agreement import FRAMES, hand_path, recording
from ..model.learn.training.test_poses import PROBE
from ..scripts import benchmark

results, methods, ablations, localization, policy = map(
    benchmark, ("results_tables", "methods_tables", "ablations", "localization", "policy")
)
BESIDE = """
from pathlib import Path
import measuring

meeting = Path(__file__).with_name("meeting")
measuring.STAGE = Path(__file__).parent

def meet(way):
    with open(meeting, way):  # waits for the other
        return {"way": way}

if __name__ == "__main__":
    measuring.measure_runs("pair", None, {way: lambda _, way=way: meet(way) for way in "rw"}, at_once=2)
"""
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


def test_runs_are_measured_beside_each_other_into_one_file(tmp_path):
    """Each of two waits until the other is there."""
    program = tmp_path / "pair.py"
    program.write_text(BESIDE)
    os.mkfifo(tmp_path / "meeting")
    environment = {**os.environ, "PYTHONPATH": str(Path(results.__file__).parent)}
    subprocess.run([sys.executable, program, tmp_path], env=environment, timeout=600, check=True)
    measured = json.loads((tmp_path / "pair.json").read_text())
    assert {run: of["way"] for run, of in measured.items()} == {"r": "r", "w": "w"}


def test_what_policies_reached_is_a_row_for_each():
    found = {"starts": 200, "learned_s": 100.0, "reached": 0.925, "steps": 9.0, "confidence": 0.5}
    *_, row = policy.reached_planes({"frames alone": found})
    assert row == "| frames alone | 200 | 92% | 9 | 0.50 | 100 s |"


def test_trainings_of_a_hand_are_measured_without_one_part_of_their_path_each(monkeypatch):
    tracked = hand_path()
    following = recording(with_shares(tracked, [range(FRAMES)], PROBE, (0.0, 0.0, 0.0)), tracked)
    monkeypatch.setattr(ablations.HandSweep, "of", lambda *_: SimpleNamespace(recorded=lambda errors: following))
    monkeypatch.setattr(ablations, "SHORTER", {**SETTINGS, "confidence": False})
    names = [
        f"one pass of a hand, {part}, seed 0" for part in (ablations.AS_IT_IS, "tissue is rigid", "poses as tracked")
    ]
    found = {name: ablations.HAND_RUNS[name](Path()) for name in names}
    assert ["on_path" in run for run in found.values()] == [True, False, False]
    for variation, (_, parts) in ablations.OF_PATH.items():
        assert all(hasattr(agreement, part) for part in parts), variation
    head, _, as_it_is, *others = ablations.path_without(ablations.of_hands(found))
    assert head == "|  | one pass of a hand, as given | one pass of a hand, on the path |"
    assert f"{found[names[0]]['on_path']['psnr_db']:.2f} ± 0.00" in as_it_is
    assert others[-1].endswith("| – |")
