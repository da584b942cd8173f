"""The work of evaluations, in this process, and what the queue makes of them."""

import json

import numpy as np
import pytest

from ultragray import ConvexProbe, GaussianScene
from ultragray.errors import DatasetInvalid
from ultragray.learn.evaluation import scoring
from ultragray.learn.evaluation.baselines import BY_POSE, IN_TIME
from ultragray.learn.evaluation.scoring import evaluate
from ultragray.learn.sweep import Dataset
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import DatasetNotFound, SceneNotFound
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.kinds import EvaluateJob, evaluate_run
from ultragray_workers.jobs.kinds.base import from_dict, to_dict
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped
from ultragray_workers.scenes import SceneStore

from ..conftest import PROBE, request_of, tiny_dataset

JOB = EvaluateJob("tiny", "one")


@pytest.fixture
def job_run(artifact_folder, random_scene):
    """The run of a job whose folder holds its scene."""

    def make(job=JOB, probe=PROBE, should_stop=lambda: False):
        folder = JobFolder(artifact_folder, "job")
        folder.path.mkdir(parents=True)
        random_scene(60, info={"probe": probe}).save(folder.path / "one.ugr")
        return JobRun(folder, request_of(to_dict(job), artifact_folder), should_stop)

    return make


def test_scores_are_those_of_the_library(job_run, monkeypatch):
    monkeypatch.setattr(scoring, "frames_at_once", lambda height, width: 1)
    asked = job_run()
    outcome = from_dict(asked.request.specification).run(asked)
    held_out = DatasetStore(asked.folder.artifact_folder).load("tiny").val
    expected = evaluate(GaussianScene.load(asked.folder.path / "one.ugr"), held_out)
    assert outcome.metrics == pytest.approx(expected.mean.to_dict() | expected.speckle.figures())
    assert (asked.progress.frames_done, asked.progress.frames) == (len(held_out), len(held_out))
    document = json.loads((asked.folder.artifacts / "evaluation.json").read_text())
    assert [one["frame"] for one in document["frames"]] == held_out.frame_numbers.tolist()
    assert document["dataset_sha256"] == tiny_dataset().sha256
    assert document["baselines"] == {}
    assert document["held_out"]["as_given"]["mean"] == document["mean"]
    assert sum(name.startswith("frame_") for name in outcome.artifacts) == len(held_out)


@pytest.mark.parametrize("is_of_another", [False, True])
def test_baselines_are_scored_beside_it(job_run, capsys, monkeypatch, is_of_another):
    if is_of_another:
        monkeypatch.setattr(Dataset, "places", None)
    outcome = evaluate_run.run(job_run(), EvaluateJob("tiny", "one", baselines=True))
    assert {f"{method}_psnr_db" for method in BY_POSE} < set(outcome.metrics)
    assert (f"{IN_TIME}_psnr_db" in outcome.metrics) != is_of_another
    assert ("of another recording: they have no neighbours in time" in capsys.readouterr().err) == is_of_another
    assert all(np.isfinite(value) for value in outcome.metrics.values())


def test_another_kind_of_probe_cannot_be_compared(job_run):
    asked = job_run(probe=ConvexProbe(60.0, 10.0, 60.0))
    with pytest.raises(DatasetInvalid, match="trained with a convex one"):
        evaluate_run.run(asked, JOB)
    assert not asked.folder.artifacts.exists()


def test_a_job_that_is_to_stop_leaves_nothing(job_run):
    asked = job_run(should_stop=lambda: True)
    with pytest.raises(Stopped):
        evaluate_run.run(asked, JOB)
    assert not asked.folder.artifacts.exists()


def test_the_queue_keeps_its_scene_and_its_dataset(artifact_folder, tmp_path, random_scene):
    random_scene(20, info={"probe": PROBE}).save(tmp_path / "one.ugr")
    store = JobStore(artifact_folder, None, scenes=SceneStore(tmp_path))
    job, _ = store.submit(JOB)
    assert (artifact_folder / "jobs" / job.id / "one.ugr").is_file()
    assert store.uses_dataset("tiny") == f"the job {job.id}"
    assert store.makes_scene("one") is None
    with pytest.raises(DatasetNotFound):
        store.submit(EvaluateJob("gone", "one"))
    with pytest.raises(SceneNotFound):
        store.submit(EvaluateJob("tiny", "gone"))
    store.close()
