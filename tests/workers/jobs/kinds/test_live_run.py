"""What a live job makes of a sweep when its last frame has come."""

from types import SimpleNamespace

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.learn.sweep import Dataset, Sweep, split_sequence
from ultragray.learn.training.growing import GrowingTrainer
from ultragray_workers.jobs.kinds import live_run

PROBE, FRAMES = LinearProbe(20.0, 0.0, 25.0), 12


@pytest.fixture(scope="module")
def sweep():
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 1, 3] = 0.4 * np.arange(FRAMES)
    images = np.random.default_rng(0).integers(0, 250, (FRAMES, 16, 16), dtype=np.uint8)
    return Sweep(images, poses, PROBE, np.arange(FRAMES), "sweep")


def settled(dataset, monkeypatch):
    """How often a sweep is learned anew and served after its last frame, without the seconds that this takes."""
    live, done = object.__new__(live_run._Live), []
    live.following = SimpleNamespace(dataset=dataset)
    live.trainer = trainer = GrowingTrainer("sweep", PROBE)
    trainer.add(*live_run.in_recorded_order(dataset))
    for constant in ("SETTLE_S", "LEAST_SETTLE_S"):
        monkeypatch.setattr(live_run, constant, 1e-9)
    monkeypatch.setattr(live, "serve", lambda: done.append(live.trainer))
    monkeypatch.setattr(live, "_tell", lambda: None)
    live.settle()
    assert all(one is not trainer for one in done)
    return len(done)


def test_a_recording_that_is_over_is_learned_anew_and_served(sweep, monkeypatch):
    assert settled(Dataset("sweep", *split_sequence(sweep, FRAMES, None, None)), monkeypatch) == 1


def test_a_data_set_that_holds_out_other_frames_is_left_to_the_training(sweep, monkeypatch):
    dataset = Dataset("sweep", sweep.select(np.arange(8)), sweep.select(np.arange(8, FRAMES)))
    assert settled(dataset, monkeypatch) == 0
