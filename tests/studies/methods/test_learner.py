"""Fits of learned methods within their budgets: interrupted ones end as undisturbed ones."""

import time
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ultragray.errors import InvalidArgument, TrainingDiverged, TrainingStateInvalid
from ultragray_studies.methods import learner
from ultragray_studies.methods.learner import MODEL_FILE, STATE_FILE, without_subnormals
from ultragray_studies.methods.method import Budget, FitRun, Pace, Paces

from .conftest import SIDE

AUTHOR = Budget.author()


def frames_of(method, dataset, run=None):
    fitted = method.fit(dataset, AUTHOR, run)
    return fitted.render(dataset.probe, dataset.val.poses, SIDE, SIDE)


def stopping_after(steps, told, **options):
    return FitRun(report=told.append, should_stop=lambda: len(told) == steps, **options)


def test_a_fit_learns_and_tells_its_cost(mean_image, make_dataset):
    dataset = make_dataset()
    told = []
    fitted = mean_image.fit(dataset, AUTHOR, FitRun(report=told.append))
    assert (fitted.cost.steps, fitted.cost.of_steps, fitted.cost.is_short) == (100, 100, False)
    assert fitted.cost.model_bytes == 4 * SIDE * SIDE
    assert fitted.cost.seconds > 0.0
    assert [one.step for one in told] == list(range(1, 101))
    assert told[-1].loss < 0.1 * told[0].loss
    assert told[-1].seconds_left == 0.0
    frames = fitted.render(dataset.probe, dataset.val.poses, SIDE, SIDE)
    assert (frames.shape, frames.dtype) == (dataset.val.images.shape, np.float32)
    assert np.abs(frames[0] - dataset.train.images.mean(axis=0) / 255.0).mean() < 0.02


def test_a_stopped_fit_ends_in_the_model_of_an_undisturbed_one(mean_image, make_dataset, tmp_path):
    dataset = make_dataset()
    for stop in (20, 50):
        assert mean_image.fit(dataset, AUTHOR, stopping_after(stop, [], folder=tmp_path)) is None
        assert [path.name for path in tmp_path.iterdir()] == [STATE_FILE]
    ended = frames_of(mean_image, dataset, FitRun(folder=tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == [MODEL_FILE]
    np.testing.assert_array_equal(ended, frames_of(mean_image, dataset))


def test_a_finished_fit_is_found_in_its_folder(mean_image, make_dataset, tmp_path):
    dataset = make_dataset()
    first = mean_image.fit(dataset, AUTHOR, FitRun(folder=tmp_path))
    told = []
    again = mean_image.fit(dataset, AUTHOR, FitRun(folder=tmp_path, report=told.append))
    assert not told
    assert again.cost == first.cost
    poses = dataset.val.poses
    np.testing.assert_array_equal(
        again.render(dataset.probe, poses, SIDE, SIDE), first.render(dataset.probe, poses, SIDE, SIDE)
    )


@pytest.mark.parametrize("folder", [None, "fit"])
def test_a_fit_that_was_timed_in_a_busy_moment_gets_its_time(folder, mean_image, make_dataset, tmp_path, monkeypatch):
    clock = SimpleNamespace(perf_counter=count(0.0, 0.01).__next__, monotonic=time.monotonic)  # a step takes 0.01 s
    monkeypatch.setattr(learner, "time", clock)
    budget = Budget.equal(0.5)
    budget.paces.keep(mean_image.name, Pace(0.0, 0.5, is_confirmed=False))
    run = FitRun(folder=None if folder is None else tmp_path / folder)
    fitted = mean_image.fit(make_dataset(), budget, run)
    assert fitted.cost.steps > 1  # which that pace would leave
    again = mean_image.fit(make_dataset(), budget)
    assert again.cost.steps == fitted.cost.steps


def test_the_seed_decides_what_is_drawn(mean_image, make_dataset):
    dataset = make_dataset()
    torch.manual_seed(1)  # of others: it changes nothing
    one = frames_of(mean_image, dataset, FitRun(seed=1))
    np.testing.assert_array_equal(one, frames_of(mean_image, dataset, FitRun(seed=1)))
    assert np.abs(one - frames_of(mean_image, dataset, FitRun(seed=2))).max() > 0.0


def test_the_folder_of_another_fit_is_refused(mean_image, make_dataset, tmp_path):
    dataset = make_dataset()
    mean_image.fit(dataset, AUTHOR, stopping_after(3, [], folder=tmp_path))
    for other, run in ((make_dataset(frames=9), FitRun(folder=tmp_path)), (dataset, FitRun(folder=tmp_path, seed=7))):
        with pytest.raises(TrainingStateInvalid, match="belongs to another fit: mean-image with seed 0"):
            mean_image.fit(other, AUTHOR, run)


@pytest.mark.parametrize("damage", [b"", b"\x00" * 100, None])
def test_a_damaged_state_is_refused_with_its_name(mean_image, make_dataset, tmp_path, damage):
    dataset = make_dataset()
    mean_image.fit(dataset, AUTHOR, stopping_after(3, [], folder=tmp_path))
    path = tmp_path / STATE_FILE
    path.write_bytes(path.read_bytes()[:-8] if damage is None else damage)
    with pytest.raises(TrainingStateInvalid, match=STATE_FILE):
        mean_image.fit(dataset, AUTHOR, FitRun(folder=tmp_path))


def test_a_fit_that_diverges_says_in_which_step(mean_image, make_dataset):
    learner = mean_image.learner(make_dataset(), AUTHOR, 0, torch.device("cpu"))
    learner.module.get_parameter("image").data.fill_(float("inf"))
    with pytest.raises(TrainingDiverged, match="step 5: the loss is"):
        learner.take_step(4, 10)


def never():
    raise AssertionError("it was measured again")


def test_an_author_gets_the_published_steps_and_an_equal_time_what_it_holds():
    assert Budget.author().steps("any", 200_000, never) == 200_000
    assert Budget.equal(10.0).steps("any", 200_000, lambda: Pace(start_s=1.0, step_s=0.09)) == 100
    assert Budget.equal(0.5).steps("any", 10, lambda: Pace(start_s=1.0, step_s=3.0)) == 1


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_a_time_that_is_none_is_refused(seconds):
    with pytest.raises(InvalidArgument, match="must be positive"):
        Budget.equal(seconds)


def test_a_pace_is_measured_once_on_a_machine(tmp_path):
    path = tmp_path / "cache" / "paces.json"
    here = {"processor": "one", "threads": 2}
    first = Budget.equal(10.0, Paces(path, here)).steps("any", 9, lambda: Pace(0.0, 0.1))
    assert Budget.equal(10.0, Paces(path, here)).steps("any", 9, never) == first == 100
    assert Budget.equal(10.0, Paces(path, here)).steps("another", 9, lambda: Pace(0.0, 1.0)) == 10
    elsewhere = {"processor": "another", "threads": 2}
    assert Budget.equal(10.0, Paces(path, elsewhere)).steps("any", 9, lambda: Pace(0.0, 0.2)) == 50


def test_a_fit_that_used_a_part_of_its_time_shows_its_pace():
    budget = Budget.equal(10.0)
    budget.steps("any", 9, lambda: Pace(1.0, 0.9, is_confirmed=False))
    assert budget.shown_pace("any", 10, 9.0) is None  # as promised
    assert budget.shown_pace("any", 10, 4.0) == Pace(1.0, 0.3, is_confirmed=False)
    budget.paces.confirm("any")
    assert budget.shown_pace("any", 10, 4.0) is None  # the table stays
    assert Budget.author().shown_pace("any", 10, 4.0) is None


@pytest.mark.parametrize("content", ["", "[]", '{"{}": {"any": ["x", 1, true]}}', '{"{}": {"any": [1]}}', '{"{}": 3}'])
def test_a_damaged_file_of_paces_is_measured_again(tmp_path, content):
    path = tmp_path / "paces.json"
    path.write_text(content)
    assert Paces(path).get("any", lambda: Pace(1.0, 2.0)) == Pace(1.0, 2.0)
    assert Paces(path).get("any", never) == Pace(1.0, 2.0)


LARGE = 4_000_000  # values: torch takes all its threads


def halves_that_stay():
    """How many of many smallest normal numbers are not 0 when they are halved."""
    smallest = torch.full((LARGE,), torch.finfo(torch.float32).tiny)
    return int((smallest * 0.5).view(torch.int32).count_nonzero())  # as bits: to compare is arithmetic too


def test_they_are_zero_in_every_thread_and_none_elsewhere():
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        assert halves_that_stay() == LARGE  # and torch has its helpers
        assert without_subnormals(halves_that_stay) == 0
        assert halves_that_stay() == LARGE
    finally:
        torch.set_num_threads(threads)
