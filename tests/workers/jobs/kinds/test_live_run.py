"""What a live job makes of a sweep when its last frame has come."""

from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.learn.sweep import Dataset, Sweep, split_sequence
from ultragray.learn.training.growing import GrowingTrainer
from ultragray_workers.jobs.kinds import live_run
from ultragray_workers.jobs.progress import Progress

PROBE, FRAMES = LinearProbe(20.0, 0.0, 25.0), 12


@pytest.fixture(scope="module")
def sweep():
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 1, 3] = 0.4 * np.arange(FRAMES)
    images = np.random.default_rng(0).integers(0, 250, (FRAMES, 16, 16), dtype=np.uint8)
    return Sweep(images, poses, PROBE, np.arange(FRAMES), "sweep")


def served(dataset, monkeypatch, tmp_path, is_worse=lambda trainer: False):
    """The scenes that are served from the last frame on, and the trainer before; the clock ticks when it is asked."""
    ticks, scenes = count(), []
    monkeypatch.setattr(live_run, "time", SimpleNamespace(monotonic=lambda: float(next(ticks))))
    monkeypatch.setattr(GrowingTrainer, "is_worse", lambda trainer, _: is_worse(trainer))
    live = object.__new__(live_run._Live)
    live.following, live._run = SimpleNamespace(dataset=dataset), SimpleNamespace(progress=Progress())
    live._judged = tmp_path / live_run.JUDGED
    live.trainer = trainer = GrowingTrainer("sweep", PROBE)
    trainer.add(*live_run.in_recorded_order(dataset))
    monkeypatch.setattr(live, "publish", scenes.append)
    monkeypatch.setattr(live, "_tell", lambda: None)
    live.settle()
    return scenes, trainer


def test_a_recording_that_is_over_is_served_as_it_is_and_then_learned_anew(sweep, monkeypatch, tmp_path):
    dataset = Dataset("sweep", *split_sequence(sweep, FRAMES, None, None))
    scenes, before = served(dataset, monkeypatch, tmp_path)
    assert np.array_equal(scenes[0].splats["means"], before.scene(before.judge()).splats["means"])
    steps = [scene.info.training["step"] for scene in scenes]
    assert len(steps) > 2
    assert steps == sorted(set(steps))


def test_versions_that_are_worse_are_not_served_meanwhile(sweep, monkeypatch, tmp_path):
    dataset = Dataset("sweep", *split_sequence(sweep, FRAMES, None, None))
    scenes, before = served(dataset, monkeypatch, tmp_path, lambda trainer: trainer.step > 0)
    assert [scene.info.training["step"] for scene in scenes] == [before.step]


def test_a_data_set_that_holds_out_other_frames_is_left_to_the_training(sweep, monkeypatch, tmp_path):
    dataset = Dataset("sweep", sweep.select(np.arange(8)), sweep.select(np.arange(8, FRAMES)))
    assert served(dataset, monkeypatch, tmp_path)[0] == []


def test_another_process_goes_on_from_what_is_served(sweep, monkeypatch, tmp_path):
    scenes = []
    live = object.__new__(live_run._Live)
    live._run, live._job = SimpleNamespace(progress=Progress()), SimpleNamespace(version_every_s=0.0)
    live._judged, live._checkpoint = tmp_path / live_run.JUDGED, tmp_path / live_run.CHECKPOINT
    live._serving_s, live._served_step = 0.0, 0
    live._served_at_s, live._saved_at_s = float("-inf"), float("inf")  # a version is due, and nothing else is
    live.trainer = GrowingTrainer("sweep", PROBE)
    live.trainer.add(sweep.images, sweep.poses)
    live.trainer.take_step()
    monkeypatch.setattr(live, "publish", scenes.append)
    live._serve_now_and_then()
    again = GrowingTrainer("sweep", PROBE)
    again.restore(live._checkpoint, sweep.images, sweep.poses)
    assert [scene.info.training["step"] for scene in scenes] == [again.step] == [1]
