"""The work of comparisons, in this process, and by workers that die on the way."""

import json
import os
import shutil
import signal
from dataclasses import replace

import pytest

from ultragray.errors import ExtraMissing, InvalidArgument, MemoryExceeded, TrainingDiverged
from ultragray.learn.evaluation.baselines import evaluate_baselines
from ultragray_studies import compare_run
from ultragray_studies.methods.classical import Compounding, FromFrames
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import DatasetNotFound
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.kinds import CompareJob, base
from ultragray_workers.jobs.kinds.base import from_dict, to_dict
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped

from ..conftest import request_of

JOB = CompareJob(dataset="tiny", methods=("median", "nearest"))


@pytest.fixture
def job_run(artifact_folder):
    """The run of a job."""

    def make(job_id="job", should_stop=lambda: False):
        folder = JobFolder(artifact_folder, job_id)
        folder.path.mkdir(parents=True, exist_ok=True)
        return JobRun(folder, request_of(to_dict(JOB), artifact_folder), should_stop)

    return make


def test_scores_are_those_of_the_library(job_run):
    asked = job_run()
    outcome = from_dict(asked.request.specification).run(asked)
    dataset = DatasetStore(asked.folder.artifact_folder).load("tiny")
    expected = {
        f"{name}_{metric}": value
        for name, evaluation in evaluate_baselines(dataset, ("median", "nearest")).items()
        for metric, value in evaluation.mean.to_dict().items()
    }
    assert outcome.metrics == pytest.approx(expected)
    assert outcome.artifacts == ("comparison.html", "comparison.json", "comparison.tex")
    document = json.loads((asked.folder.artifacts / "comparison.json").read_text())
    assert [one["name"] for one in document["results"]] == ["median", "nearest"]
    progress = asked.progress
    assert (progress.method, progress.method_number, progress.methods) == ("nearest", 2, 2)


def test_the_log_of_a_job_has_the_warnings_of_its_dataset(job_run, monkeypatch, capsys):
    get = DatasetStore.get
    monkeypatch.setattr(
        DatasetStore, "get", lambda store, name: replace(get(store, name), warnings=("train: frame 4 lies off",))
    )
    job_run().load_dataset("tiny")
    assert capsys.readouterr().err == "warning: train: frame 4 lies off\n"


def test_a_job_that_is_to_stop_goes_on_in_its_retry(job_run, artifact_folder):
    first = job_run()
    first.should_stop = lambda: (first.folder.run / "median" / "result.json").exists()
    with pytest.raises(Stopped):
        compare_run.run(first, JOB)
    assert not first.folder.artifacts.exists()
    kept = (first.folder.run / "median" / "result.json").read_bytes()
    again = job_run("again")
    shutil.copytree(first.folder.run, again.folder.run)  # as the worker fetches it
    compare_run.run(again, JOB)
    assert (again.folder.run / "median" / "result.json").read_bytes() == kept


def test_a_comparison_of_which_every_method_fails_fails(job_run, monkeypatch):
    def fail(*_, **__):
        raise MemoryExceeded("it needs 9 GB")

    monkeypatch.setattr(Compounding, "fit", fail)
    monkeypatch.setattr(FromFrames, "fit", fail)
    with pytest.raises(TrainingDiverged, match="came to its end: median: it needs 9 GB; nearest: it needs 9 GB"):
        compare_run.run(job_run(), JOB)


def test_what_cannot_be_is_refused_at_the_submission(artifact_folder, store):
    with pytest.raises(InvalidArgument, match="got 'newest'"):
        CompareJob(dataset="tiny", methods=("newest",))
    with pytest.raises(InvalidArgument, match="budget must be"):
        CompareJob(dataset="tiny", budget="half")
    with pytest.raises(DatasetNotFound):
        store.submit(CompareJob(dataset="gone"))
    assert from_dict(to_dict(JOB)) == JOB


@pytest.mark.long
def test_killed_comparison_goes_on_and_repeats_no_step(store, start_worker, until):
    job, _ = store.submit(CompareJob(dataset="tiny", methods=("scene", "nearest")))
    worker = start_worker("one")
    until(job, lambda job: "scene: step" in store.log_tail(job.id))
    process = worker.job_process()
    os.kill(process, signal.SIGTERM)  # leaves a checkpoint
    done = until(job)
    assert (done.state, done.kind, done.attempts) == (JobState.SUCCEEDED, "compare", 2), done
    assert {"scene_psnr_db", "nearest_gmsd"} < set(done.metrics)
    lines = [line for line in store.log_tail(job.id).splitlines() if line.startswith("scene: step")]
    assert len(lines) == len({line.partition(" of ")[0] for line in lines}) == 10, lines


def test_without_the_studies_a_comparison_is_refused_in_words(monkeypatch):
    monkeypatch.setattr(base, "entry_points", lambda **_: ())
    surroundings = base.Surroundings(scene=None, free_bytes=None, max_image_side=1024)
    with pytest.raises(ExtraMissing, match="ultragray-studies, which is not installed"):
        JOB.check(surroundings)
