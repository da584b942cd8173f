"""The work of motion jobs, in this process, and what the queue makes of them."""

import json

import numpy as np
import pytest
import torch

from ultragray import GaussianScene
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.learn.motion import add_motion
from ultragray.scene.motion_settings import MotionSettings
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import DatasetNotFound, SceneExists
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.kinds import MotionJob, motion_run
from ultragray_workers.jobs.kinds.base import to_dict
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped
from ultragray_workers.scenes import SceneStore

from ..conftest import PROBE, request_of

CHEST = MotionJob(scene="one", into="moving", chest_mm=5.0)
LEARNED = MotionJob(scene="one", into="moving", dataset="tiny", numbers=tuple(np.arange(8.0)), steps=3)


@pytest.fixture
def job_run(artifact_folder, random_scene):
    """The run of a job whose folder holds its scene."""
    torch.set_num_threads(1)

    def make(job, should_stop=lambda: False):
        folder = JobFolder(artifact_folder, "job")
        folder.path.mkdir(parents=True)
        random_scene(60, info={"probe": PROBE}).save(folder.path / "one.ugr")
        return JobRun(folder, request_of(to_dict(job), artifact_folder), should_stop)

    return make


def test_the_scene_is_that_of_the_library(job_run):
    asked = job_run(CHEST)
    outcome = motion_run.run(asked, CHEST)
    assert set(outcome.artifacts) == {"moving.ugr", "motion.json"}
    expected = add_motion(GaussianScene.load(asked.folder.path / "one.ugr"), MotionSettings(chest_mm=5.0))
    assert (asked.folder.artifacts / "moving.ugr").read_bytes() == expected.scene.to_bytes()
    facts = json.loads((asked.folder.artifacts / "motion.json").read_text())
    assert (facts["modes"][0]["name"], facts["numbers"]) == ("breathing", None)


def test_a_mode_is_learned_from_a_dataset_whose_recording_has_numbers(job_run):
    asked = job_run(LEARNED)
    motion_run.run(asked, LEARNED)
    (mode,) = GaussianScene.load(asked.folder.artifacts / "moving.ugr").info.motion.modes
    train = DatasetStore(asked.folder.artifact_folder).load("tiny").train
    assert (mode.low, mode.high) == (train.frame_numbers.min(), train.frame_numbers.max())
    assert (asked.progress.step, asked.progress.steps) == (3, 3)


def test_numbers_are_found_where_none_are_given(job_run):
    job = MotionJob(scene="one", into="moving", dataset="tiny", steps=3)
    asked = job_run(job)
    motion_run.run(asked, job)
    facts = json.loads((asked.folder.artifacts / "motion.json").read_text())
    assert (min(facts["numbers"]), max(facts["numbers"])) == (0.0, 1.0)


def test_a_recording_with_fewer_numbers_than_frames_is_refused(job_run):
    few = MotionJob(scene="one", into="moving", dataset="tiny", numbers=(1.0, 2.0))
    with pytest.raises(DatasetInvalid, match="each of 6 frames, got"):
        motion_run.run(job_run(few), few)


def test_a_job_that_is_to_stop_leaves_nothing(job_run):
    asked = job_run(LEARNED, should_stop=lambda: True)
    with pytest.raises(Stopped):
        motion_run.run(asked, LEARNED)
    assert not asked.folder.artifacts.exists()


def test_a_job_has_one_source():
    with pytest.raises(InvalidArgument, match="exactly one of chest_mm, pulse_mm, dataset, got none"):
        MotionJob(scene="one", into="moving")
    with pytest.raises(InvalidArgument, match="numbers are of the frames of a dataset"):
        MotionJob(scene="one", into="moving", chest_mm=1.0, numbers=(1.0,))


def test_the_queue_keeps_its_scene_and_its_dataset(artifact_folder, tmp_path, random_scene):
    scene = random_scene(20, info={"probe": PROBE})
    scene.save(tmp_path / "one.ugr")
    add_motion(scene, MotionSettings(chest_mm=5.0)).scene.save(tmp_path / "breathing.ugr")
    store = JobStore(artifact_folder, None, scenes=SceneStore(tmp_path))
    job, _ = store.submit(LEARNED)
    assert (artifact_folder / "jobs" / job.id / "one.ugr").is_file()
    assert store.uses_dataset("tiny") == store.makes_scene("moving") == f"the job {job.id}"
    with pytest.raises(SceneExists):
        store.submit(MotionJob(scene="one", into="breathing", chest_mm=5.0))
    with pytest.raises(DatasetNotFound):
        store.submit(MotionJob(scene="one", into="other", dataset="gone"))
    with pytest.raises(InvalidArgument, match="a mode that is called breathing already"):
        store.submit(MotionJob(scene="breathing", into="other", chest_mm=5.0))
    store.close()
