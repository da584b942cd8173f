"""A scene that grows while its sweep arrives, on frames of the built-in phantom."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ultragray.errors import DatasetInvalid
from ultragray.geometry.probe import ConvexProbe, LinearProbe, RadialProbe
from ultragray.learn.evaluation.baselines import evaluate_baselines
from ultragray.learn.sweep import Dataset, Sweep, split_sequence
from ultragray.learn.training import growing
from ultragray.learn.training.batch import Batch
from ultragray.learn.training.growing import GrowingTrainer, Judgement
from ultragray.learn.training.optimizer import Optimizer
from ultragray.learn.training.poses import PoseRefinement
from ultragray.phantom import PHANTOM_PROBE, freehand_poses
from ultragray.phantom.imaging import simulate
from ultragray.scene.confidence import Assessor

SIDE, COUNT = 48, 24


@pytest.fixture(scope="module")
def sweep():
    poses = freehand_poses(91)[30 : 30 + COUNT]
    images = simulate(poses, probe=PHANTOM_PROBE, height=SIDE, width=SIDE)
    return Sweep(images, poses, PHANTOM_PROBE, np.arange(COUNT), "phantom")


def grown(sweep, until=COUNT, steps=3):
    trainer = GrowingTrainer("phantom", PHANTOM_PROBE)
    for place in range(until):
        trainer.add(sweep.images[place : place + 1], sweep.poses[place : place + 1])
        for _ in range(steps if trainer.is_growing else 0):
            trainer.take_step()
    return trainer


def all_psnr_db(trainer, monkeypatch):
    for some in ("JUDGES", "NEW_JUDGES"):
        monkeypatch.setattr(growing, some, COUNT)
    return trainer.judge().mean_psnr_db


@pytest.mark.parametrize(("same", "size"), [(2.0, (SIDE // 2, SIDE // 2)), (-2.0, (SIDE, SIDE // 4))])
def test_a_sweep_that_is_over_is_learned_anew_from_small_frames_or_some_of_the_lines(sweep, same, size, monkeypatch):
    monkeypatch.setattr(growing, "SMALL_PIXELS", (SIDE // 2) ** 2)
    monkeypatch.setattr(growing, "SAME_DETAIL", same)
    for most in ("MOST_AT_ONCE", "MOST_OF_DETAIL"):
        monkeypatch.setattr(growing, most, 1000)
    sizes, true_render = [], growing.render
    monkeypatch.setattr(
        growing, "render", lambda *a, **k: sizes.append((k["height"], k["width"])) or true_render(*a, **k)
    )
    dataset = Dataset("phantom", *split_sequence(sweep, COUNT, None, None))
    trainer = grown(sweep, steps=0)
    trainer.accept(trainer.judge())
    again = trainer.anew(dataset)
    at_first = all_psnr_db(again, monkeypatch)
    for step in range(80):
        again.take_step(0.1 ** (step / 80))
    judgement = again.judge()
    assert set(sizes) == {size}
    assert judgement.mean_psnr_db > at_first + 2.0
    assert not again.is_worse(judgement)  # than what was shown of the frames as they came
    scene = again.scene(judgement)
    assert (scene.info.image_height, scene.gaussian_count) == (SIDE, 1000)
    assert len(scene.training_poses) == len(dataset.train)


@pytest.mark.parametrize(
    "probe", [LinearProbe(40.0, 2.0, 42.0), ConvexProbe(60.0, 20.0, 60.0), RadialProbe(2.0, 30.0)], ids=str
)
def test_some_of_the_lines_are_those_of_a_probe_that_is_moved(sweep, probe):
    random = torch.Generator().manual_seed(0)
    truth, weights = torch.rand((2, 4, 16, 32), generator=random)
    shadowed = torch.rand((9, 16, 32), generator=random) > 0.5
    neighbours = torch.tensor([[2, 2], [5, 5], [5, 2], [8, 2]])
    whole = Batch(sweep.poses[:4], neighbours[:, 0], neighbours, truth, weights[2:])
    places = (np.arange(16) + 0.5) / 16, (np.arange(32) + 0.5) / 32, (np.arange(8) + 0.5) / 8
    points = probe.points_mm(*np.meshgrid(places[0], places[1], indexing="ij"))[:, 1::4] @ whole.poses[0, :3, :3].T
    some, some_shadowed = whole.of_lines(probe.lines, 1, 4, shadowed)
    moved = probe.points_mm(*np.meshgrid(places[0], places[2], indexing="ij")) @ some.poses[0, :3, :3].T
    assert moved + some.poses[0, :3, 3] == pytest.approx(points + whole.poses[0, :3, 3])
    assert torch.equal(some.truth, truth[..., 1::4])
    assert torch.equal(some.weights, weights[2:, :, 1::4])
    assert torch.equal(some_shadowed[some.neighbours], shadowed[neighbours][..., 1::4])


def test_poses_of_a_sweep_that_is_over_are_those_that_its_whole_frames_agree_with(sweep, monkeypatch):
    monkeypatch.setattr(growing, "SMALL_PIXELS", (SIDE // 2) ** 2)
    sides, true_of = [], PoseRefinement.of
    monkeypatch.setattr(PoseRefinement, "of", lambda one, mode: sides.append(one.train.height) or true_of(one, mode))
    grown(sweep, steps=0).anew(Dataset("phantom", *split_sequence(sweep, COUNT, None, None)))
    assert sides == [SIDE]


@pytest.mark.parametrize(("like", "smaller"), [((), (2, 2)), ((2,), (1, 4)), ((1,), (4, 1)), ((1, 2), (2, 2))])
def test_frames_become_smaller_where_pixels_are_like_their_neighbours(sweep, like, smaller, monkeypatch):
    monkeypatch.setattr(growing, "SMALL_PIXELS", SIDE * SIDE // 4)
    images = np.random.default_rng(0).integers(0, 250, sweep.images.shape, dtype=np.uint8)
    for axis in like:
        images = np.repeat(images.take(range(SIDE // 4), axis), 4, axis)
    trainer = GrowingTrainer("phantom", PHANTOM_PROBE)
    trainer.add(images, sweep.poses)
    height, width = (SIDE // part for part in smaller)
    shown = trainer._train.images
    assert shown.shape[1:] == (height, width)
    fours = images[:1].reshape(1, height, smaller[0], width, smaller[1]).mean(axis=(2, 4))
    assert np.abs(shown[:1] - fours).max() <= 0.5
    scene = trainer.scene(trainer.judge())
    assert (scene.info.image_height, scene.info.image_width) == (SIDE, SIDE)


def test_it_learns_what_lies_between_its_frames(sweep, monkeypatch):
    train, val = split_sequence(sweep, COUNT, None, None)
    linear = evaluate_baselines(Dataset("phantom", train, val), ("linear",), 1.0)["linear"].mean.psnr_db
    at_first = all_psnr_db(grown(sweep, steps=0), monkeypatch)
    trainer = grown(sweep)
    for step in range(30):
        trainer.take_step(0.1 ** (step / 30))
    settled = all_psnr_db(trainer, monkeypatch)
    assert settled > at_first + 3.0
    assert settled > linear - 3.0  # of frames of so few pixels, which have few Gaussians


def test_gaussians_begin_with_each_frame_before_any_step_on_it(sweep):
    trainer = grown(sweep, until=COUNT - 5)
    before = trainer.gaussian_count
    trainer.add(sweep.images[-5:], sweep.poses[-5:])
    assert trainer.gaussian_count > before
    judgement = trainer.judge()
    assert min(judgement.psnr_db.values()) > 12.0  # black frames have less


def test_the_first_steps_of_gaussians_are_on_small_frames(sweep, monkeypatch):
    heights, true_render = [], growing.render
    monkeypatch.setattr(growing, "render", lambda *a, **k: heights.append(k["height"]) or true_render(*a, **k))
    trainer = grown(sweep, steps=0)
    monkeypatch.setattr(growing, "COARSE_GAUSSIANS", 100.0)
    half, quarter = growing.COARSE_STEPS
    for _ in range(half + 1):
        trainer.take_step()
    assert heights == [SIDE // 4] * quarter + [SIDE // 2] * (half - quarter) + [SIDE]


def test_frames_of_an_odd_size_are_learned_as_they_are(sweep):
    trainer = GrowingTrainer("phantom", PHANTOM_PROBE)
    trainer.add(sweep.images[:, : SIDE - 1], sweep.poses)
    assert np.isfinite(trainer.take_step())


def test_a_probe_that_stands_still_adds_no_gaussians(sweep):
    trainer = grown(sweep)
    before = trainer.gaussian_count
    for _ in range(3):
        trainer.add(sweep.images[-1:], sweep.poses[-1:])
    assert trainer.gaussian_count == before
    trainer.take_step()


def test_the_same_frames_and_steps_give_the_same_scene(sweep):
    one, other = (grown(sweep, until=12).scene(Judgement({}, {})) for _ in range(2))
    for name, tensor in one.splats.items():
        assert torch.equal(tensor, other.splats[name]), name


def test_it_goes_on_from_a_checkpoint_as_if_it_had_not_been_killed(sweep, tmp_path):
    def end(trainer):
        trainer.add(sweep.images[16:20], sweep.poses[16:20])
        for _ in range(4):
            trainer.take_step()
        return trainer.judge().mean_psnr_db

    trainer = grown(sweep, until=16)
    trainer.accept(trainer.judge())
    trainer.save(tmp_path / "checkpoint")
    count = GrowingTrainer.frames_of(tmp_path / "checkpoint")
    again = GrowingTrainer("phantom", PHANTOM_PROBE)
    again.judged = dict(trainer.judged)
    again.restore(tmp_path / "checkpoint", sweep.images[:count], sweep.poses[:count])
    assert (count, again.step, again.gaussian_count) == (16, trainer.step, trainer.gaussian_count)
    assert end(again) == pytest.approx(end(trainer), abs=0.3)


def test_a_version_is_compared_with_the_one_shown_and_not_with_earlier_ones(sweep, monkeypatch):
    monkeypatch.setattr(growing, "NEW_JUDGES", 1)
    trainer = grown(sweep, steps=0)
    trainer.accept(Judgement({0: 10.0, 1: 40.0}, {}))
    trainer.accept(Judgement({1: 24.0, 2: 24.0}, {}))
    assert trainer.judge().psnr_db.keys() == {0, 1, 2}
    assert not trainer.is_worse(Judgement({0: 0.0, 1: 23.9, 2: 24.0}, {}))
    assert trainer.is_worse(Judgement({0: 40.0, 1: 23.5, 2: 24.0}, {}))


def test_a_version_shown_before_a_death_may_have_been_judged_by_frames_that_are_still_to_come_again(sweep, tmp_path):
    trainer = grown(sweep, until=12)
    trainer.save(tmp_path / "checkpoint")
    again = GrowingTrainer("phantom", PHANTOM_PROBE)
    again.restore(tmp_path / "checkpoint", sweep.images[:12], sweep.poses[:12])
    again.judged = {0: 0.0, 1: 0.0, 3: 99.0}
    judgement = again.judge()
    assert judgement.psnr_db.keys() == {0, 1}
    assert not again.is_worse(judgement)


def test_a_version_that_shows_the_same_frames_worse_is_told_from_one_that_does_not(sweep):
    trainer = grown(sweep, until=12)
    trainer.accept(trainer.judge())
    assert not trainer.is_worse(trainer.judge())
    with torch.no_grad():
        trainer._parameters["sh0"] += 1.0
    assert trainer.is_worse(trainer.judge())


def test_after_a_version_that_is_worse_steps_are_smaller(sweep):
    usual, careful = (grown(sweep, until=12) for _ in range(2))
    careful.slow_down()
    means = {}
    for trainer in (usual, careful):
        before = trainer._parameters["means"].detach().clone()
        trainer.take_step()
        means[trainer] = trainer._parameters["means"].detach() - before
    torch.testing.assert_close(2.0 * means[careful], means[usual], atol=2e-6, rtol=1e-3)
    careful.accept(careful.judge())
    assert 0.5 < careful._caution <= 1.0


def test_recent_frames_are_learned_first_and_then_all_alike(sweep, monkeypatch):
    monkeypatch.setattr(growing, "RECENT_FRAMES", 2)
    monkeypatch.setattr(growing, "RECENT_STEPS", 4)
    chosen, true_batch = [], growing.Batch.of
    monkeypatch.setattr(growing.Batch, "of", lambda *a: chosen.append(a[2].tolist()) or true_batch(*a))
    trainer = grown(sweep, steps=0)
    for _ in range(8):
        trainer.take_step()
    assert [len(own) for own in chosen] == [2, 4, 2, 4, 4, 4, 4, 4]


def test_a_version_tells_where_it_holds(sweep):
    trainer = grown(sweep)
    scene = trainer.scene(trainer.judge())
    away = sweep.poses[COUNT // 2].copy()
    away[1, 3] += 25.0
    inside, outside = Assessor(scene.info, scene.training_poses).assess(np.stack([sweep.poses[COUNT // 2], away]))
    assert outside.confidence < inside.confidence


def test_frames_too_small_to_compare_are_refused(sweep):
    with pytest.raises(DatasetInvalid, match="11 rows"):
        GrowingTrainer("tiny", PHANTOM_PROBE).add(sweep.images[:1, :8, :8], sweep.poses[:1])


def test_a_late_gaussian_takes_steps_as_long_as_those_of_others():
    def optimizer(rows):
        parameters = {"means": torch.zeros(rows, 3, requires_grad=True)}
        return parameters, Optimizer(parameters, batch_size=8)

    def step(parameters, adam):
        parameters["means"].grad = torch.ones_like(parameters["means"])
        before = parameters["means"].detach().clone()
        adam.step({"means": 1.0})
        return (parameters["means"].detach() - before).abs()

    parameters, adam = optimizer(1)
    for _ in range(50):
        step(parameters, adam)
    joined = {"means": torch.zeros(2, 3, requires_grad=True)}
    adam.replace(joined, torch.tensor([0, -1]), like_others=True)
    old, new = step(joined, adam)
    assert float(new.max()) <= 1.01 * float(old.max())
