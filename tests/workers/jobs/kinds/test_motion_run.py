"""The work of motion jobs, in this process, and what the queue makes of them."""

import base64
import json
import re
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import GaussianScene
from ultragray.errors import DatasetInvalid, InvalidArgument, InvalidPose
from ultragray.learn.motion import add_motion
from ultragray.scene.motion_settings import FieldFile, MotionSettings
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import DatasetNotFound, JobConflict, SceneExists
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.kinds import MotionJob, motion_run
from ultragray_workers.jobs.kinds.base import from_dict, to_dict
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped
from ultragray_workers.scenes import SceneStore

from ..conftest import PROBE, request_of

CHEST = MotionJob(scene="one", into="moving", chest_mm=5.0)
LEARNED = MotionJob(scene="one", into="moving", dataset="tiny", numbers=tuple(np.arange(8.0)), steps=3)


def job_of_field(into="moving"):
    """A job that moves all tissue by (2, 0, 3) mm, of a file in LPS whose frame is half a turn about z away."""
    half_turn = (-1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    head = "NRRD0004", "type: float", "dimension: 4", "sizes: 3 2 2 2", "space: left-posterior-superior"
    place = "space directions: none (200,0,0) (0,200,0) (0,0,200)", "space origin: (-100,-100,-100)"
    text = "\n".join((*head, *place, "encoding: raw", "endian: little")) + "\n\n"
    content = text.encode() + np.tile(np.array([2.0, 0.0, 3.0], "<f4"), 8).tobytes()
    file = FieldFile(data=base64.b64encode(content).decode(), format="nrrd")
    return MotionJob(scene="one", into=into, field=file, field_leads="from-rest", field_to_scene=half_turn)


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


def test_a_mode_is_that_of_a_field_of_displacements(job_run):
    job = job_of_field()
    asked = job_run(job)
    (asked.folder.path / "field.nrrd").write_bytes(job.field.content())
    motion_run.run(asked, job)
    moving = GaussianScene.load(asked.folder.artifacts / "moving.ugr").moving
    np.testing.assert_allclose(
        moving.coefficients, np.broadcast_to([2.0, 0.0, 3.0], moving.coefficients.shape), atol=1e-5
    )
    assert json.loads((asked.folder.artifacts / "motion.json").read_text())["residual_mm"]["most"] < 1e-5


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
    with pytest.raises(InvalidArgument, match="exactly one of chest_mm, pulse_mm, dataset, field, got none"):
        MotionJob(scene="one", into="moving")
    with pytest.raises(InvalidArgument, match="numbers are of the frames of a dataset"):
        MotionJob(scene="one", into="moving", chest_mm=1.0, numbers=(1.0,))
    with pytest.raises(InvalidArgument, match="field and field_leads belong together"):
        MotionJob(scene="one", into="moving", field=FieldFile(data=""))
    with pytest.raises(InvalidArgument, match="registration is of a field"):
        MotionJob(scene="one", into="moving", chest_mm=1.0, registration="robot")
    with pytest.raises(InvalidPose, match="field_to_scene"):
        replace(job_of_field(), field_to_scene=(1.0, 2.0))


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


def test_the_queue_keeps_a_field_beside_the_row_and_for_a_successor(artifact_folder, tmp_path, random_scene):
    random_scene(20, info={"probe": PROBE}).save(tmp_path / "one.ugr")
    with closing(JobStore(artifact_folder, None, scenes=SceneStore(tmp_path))) as store:
        asked = job_of_field()
        job, _ = store.submit(asked, request_id="again")
        assert store.submit(asked, request_id="again") == (job, False)
        other = replace(asked, field=replace(asked.field, data=asked.field.data[:-4]))
        with pytest.raises(JobConflict):
            store.submit(other, request_id="again")
        kept = artifact_folder / "jobs" / job.id / "field.nrrd"
        assert kept.read_bytes() == asked.field.content()
        in_row = queue.specification_of(store.database.engine, job.id)
        for told in (job.specification, in_row):
            assert re.fullmatch("sha256:[0-9a-f]{64}", told["field"]["data"])
        with pytest.raises(InvalidArgument, match="must be the file in base64") as caught:
            store.submit(replace(from_dict(in_row), into="other"))
        assert caught.value.field == "field.data"
        store.cancel(job.id)
        successor, _ = store.retry(job.id)
        again = artifact_folder / "jobs" / successor.id / "field.nrrd"
        assert again.read_bytes() == kept.read_bytes()
        for one in (store.cancel(successor.id), job):
            store.delete(one.id)
        assert not kept.parent.exists()
        assert not again.parent.exists()
