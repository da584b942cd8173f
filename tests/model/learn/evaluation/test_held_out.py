"""Held-out frames by three kinds of poses: as given, on the path, and registered by halves."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import render
from ultragray.errors import DatasetInvalid
from ultragray.learn.evaluation import held_out
from ultragray.learn.evaluation.held_out import register_halves, score_held_out
from ultragray.learn.evaluation.scoring import evaluate
from ultragray.learn.sweep import Sweep
from ultragray.learn.training import train
from ultragray.learn.training.agreement import with_shares
from ultragray.learn.training.poses import held_out_on_path

from ..training.test_agreement import FRAMES, hand_path, recording
from ..training.test_poses import PROBE, freehand_path


def test_a_frame_that_is_off_is_scored_by_the_half_that_did_not_move_it(random_scene):
    """Registered on one half it scores better on the other; a frame in place gains little."""
    scene, poses = random_scene(200, extent_cm=(4.0, 2.0, 5.0), sigma_cm=(0.1, 0.4)), freehand_path(3)
    images = render(scene, PROBE, poses, height=40, width=40, outputs=("bmode",))["bmode"]
    frames = Sweep((255.0 * images.numpy()).round().astype(np.uint8), poses, PROBE, np.arange(3), "rendered")
    moved = replace(frames, poses=poses + 2.0 * np.eye(4, k=3))
    off = register_halves(scene, moved)
    gain_db = off.evaluation.mean.psnr_db - evaluate(scene, moved).mean.psnr_db
    assert gain_db > 0.5
    assert 0.5 < off.moved_mm < 4.0
    in_place = register_halves(scene, frames)
    assert in_place.evaluation.mean.psnr_db - evaluate(scene, frames).mean.psnr_db < gain_db


def test_a_half_is_scored_as_the_other_moved_it(tiny_dataset, random_scene, monkeypatch):
    """The left half asks for a shift that does nothing but make the right one better."""
    sweep = tiny_dataset(frames=16, height=40, width=40).val
    given = torch.from_numpy(sweep.poses)

    def fitted(scene, frames, truth, columns, backend):
        return given + (5.0 if columns.start == 0 else 0.0) * torch.from_numpy(np.eye(4, k=3))

    def rendered(scene, frames, poses, backend):
        found = torch.from_numpy(frames.images).float() / 255.0
        found[..., 20:] += 0.1 if torch.equal(poses, given) else 0.01
        return found

    monkeypatch.setattr(held_out, "_fitted", fitted)
    monkeypatch.setattr(held_out, "_rendered", rendered)
    score = register_halves(random_scene(3), sweep)
    assert score.evaluation.mean.psnr_db == pytest.approx(40.0 + 10.0 * np.log10(2.0), abs=0.1)
    assert score.moved_mm == pytest.approx(2.5)


def test_halves_that_are_too_narrow_are_refused(tiny_dataset, random_scene):
    with pytest.raises(DatasetInvalid, match=r"registered by halves.*22 columns, got 20x16"):
        register_halves(random_scene(3), tiny_dataset().val)


def test_three_scores_stand_side_by_side(tiny_config):
    tracked = hand_path()
    given = recording(with_shares(tracked, [range(FRAMES)], PROBE, (0.0, 0.0, 0.0)), tracked)
    scene = train(given, tiny_config(refine_poses="path"))
    few = replace(given, val=given.val.select(range(2)))
    as_given = evaluate(scene, given.val)
    scores = score_held_out(scene, given, as_given)
    assert list(scores.rows) == ["as given", "on the path"]
    on_path = evaluate(scene.at_rest(), held_out_on_path(given, scene)).mean
    assert scores.figures() == {f"on_path_{name}": value for name, value in on_path.to_dict().items()}
    document = scores.to_dict()
    assert document["as_given"]["mean"] == as_given.mean.to_dict()
    assert document["on_path"]["mean"] == on_path.to_dict()
    assert document["registered"] is None
    registered = score_held_out(scene, few, evaluate(scene, few.val), register=True)
    assert registered.on_path is None  # the scene is of another split
    assert registered.to_dict()["registered"]["moved_mm"] == registered.registered.moved_mm
    assert set(registered.figures()) == {f"registered_{name}" for name in ("psnr_db", "ms_ssim", "gms", "gmsd")}
