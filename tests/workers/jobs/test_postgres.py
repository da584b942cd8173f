"""One queue in PostgreSQL under workers of several hosts, and what is told where the database cannot be used."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
import sqlalchemy as sa
import torch

from ultragray.datasets.source import load_dataset
from ultragray.learn.training import TrainingConfig, train
from ultragray.scene.gaussians import GaussianScene
from ultragray_workers.errors import DatabaseUnavailable, StartupFailed
from ultragray_workers.jobs.database import JobDatabase, checked_url
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.store import JobStore

from ...postgres import PASSWORD
from ...waiting import Deadline, at_this_load
from .conftest import files_of, train_job

# `ultragray worker`, less patient with the dead.
HOST = """
from ultragray_workers.jobs import queue
from ultragray_service.cli.app import app
queue.DEAD_AFTER_S = 3.0
app()
"""


@pytest.fixture
def database_url(postgres):
    return postgres.create_database()


@pytest.fixture
def hosts(artifact_folder, database_url, tmp_path):
    """Two machines, as far as they know: a data folder each, the artifact folder is shared."""
    running = {}
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        with (tmp_path / f"{name}.log").open("wb") as log:
            running[name] = subprocess.Popen(
                [sys.executable, "-c", HOST, "worker", "--name", name, "--device", "cpu", "--threads", "1"],
                env={
                    **os.environ,
                    "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
                    "ULTRAGRAY_DATA_FOLDER": str(tmp_path / name),
                    "ULTRAGRAY_ARTIFACT_FOLDER": str(artifact_folder),
                    "ULTRAGRAY_DATABASE_URL": database_url,
                },
                stderr=log,
                cwd=tmp_path / name,
            )
    end = Deadline(30)
    for name in running:
        while "takes jobs" not in (told := (tmp_path / f"{name}.log").read_text()):
            assert not end.passed, told
            time.sleep(0.05)
    yield running
    for process in running.values():
        process.kill()
        process.wait()


@pytest.mark.long
def test_hosts_share_one_queue_and_one_takes_over_from_the_other(store, artifact_folder, tmp_path, hosts, until):
    made = [until(job) for job in [store.submit(train_job(f"scene-{number}"))[0] for number in range(6)]]
    assert {job.state for job in made} == {JobState.SUCCEEDED}, made
    assert {job.worker for job in made} == set(hosts)
    for name in hosts:
        spans = sorted((job.started_at or "", job.finished_at or "") for job in made if job.worker == name)
        assert all(before[1] <= after[0] for before, after in pairwise(spans)), spans
    assert [(job.attempts, store.log_tail(job.id).count("training scene")) for job in made] == [(1, 1)] * 6

    asked = train_job("long", steps=500)
    job, _ = store.submit(asked)
    job = until(job, lambda job: (job.progress.step or 0) > 0)
    first = job.worker
    assert first is not None
    hosts[first].kill()
    job = until(job)
    assert (job.state, job.attempts) == (JobState.SUCCEEDED, 2), job
    assert {first, job.worker} == set(hosts)
    torch.set_num_threads(1)
    undisturbed = train(
        load_dataset(files_of(artifact_folder, "tiny")), TrainingConfig.preset("fast", **asked.settings)
    )
    served = GaussianScene.load(artifact_folder / "scenes" / "long.ugr")
    for name, tensor in undisturbed.splats.items():
        assert torch.equal(served.splats[name], tensor), name
    for name in hosts:
        assert PASSWORD not in (tmp_path / f"{name}.log").read_text()


@pytest.mark.long
def test_training_goes_on_while_the_database_is_away(store, postgres, tmp_path, start_worker, until):
    worker = start_worker()
    job, _ = store.submit(train_job("one", steps=1_000_000))
    until(job, lambda job: (job.progress.step or 0) > 0)
    process = worker.job_process()
    postgres.stop()
    try:
        began = time.monotonic()
        for call in (store.list, lambda: store.get(job.id), lambda: store.submit(train_job("two"))):
            with pytest.raises(DatabaseUnavailable, match="does not answer"):
                call()
        assert time.monotonic() - began < at_this_load(2.0)
        time.sleep(1.5)
    finally:
        postgres.start()
    assert store.get(job.id).state is JobState.RUNNING
    assert worker.job_process() == process
    began = time.monotonic()
    store.cancel(job.id)
    while process is not None and Path(f"/proc/{process}").exists():
        assert time.monotonic() - began < at_this_load(3.0)
        time.sleep(0.01)
    two = until(store.submit(train_job("two"))[0])
    assert two.state is JobState.SUCCEEDED, (two.reason, store.log_tail(two.id))
    told = (tmp_path / "one.log").read_text().splitlines()
    assert [line.split(":")[0] for line in told] == [
        "no heartbeat for now",
        "the heartbeat is back",
    ]


def test_database_that_cannot_be_used_is_told_in_one_sentence(postgres, database_url, tmp_path, caplog):
    name = database_url.rpartition("/")[2]
    refused = {
        postgres.url("absent"): 'database "absent" does not exist',
        postgres.url(name, password="wrong!"): "password authentication failed",
        f"postgresql://me:{PASSWORD}@127.0.0.1:1/jobs": "must be postgresql://",
        "postgresql://me:s3cret@127.0.0.1:1/jobs": "Connection refused",
        f"mysql://me:s3cret@127.0.0.1/{name}": "must be postgresql://",
        "postgresql://me:s3cret@127.0.0.1": "must be postgresql://",
    }
    for url, told in refused.items():
        with pytest.raises(StartupFailed, match=told) as caught:
            JobStore(tmp_path, url)
        assert "\n" not in caught.value.detail
        assert caught.value.field == "database_url"
        for secret in ("s3cret", "wrong!"):
            assert secret not in caught.value.detail + caplog.text
    assert caplog.text == ""


def test_statement_that_takes_too_long(postgres, database_url, tmp_path):
    assert "statement_timeout" in checked_url(database_url, tmp_path)
    jobs = JobDatabase(tmp_path, f"{database_url}?options=-c%20statement_timeout%3D300")
    with pytest.raises(DatabaseUnavailable), jobs.engine.begin() as connection:
        connection.execute(sa.text("SELECT pg_sleep(20)"))
    jobs.close()


def test_role_that_sees_no_other_database_is_enough(postgres, database_url, tmp_path, caplog):
    name = database_url.rpartition("/")[2]
    postgres.execute("CREATE ROLE modest LOGIN PASSWORD 'modest'")
    postgres.execute("REVOKE CONNECT ON DATABASE postgres FROM PUBLIC")
    with pytest.raises(StartupFailed, match="permission denied"):
        JobStore(tmp_path, postgres.url(name, user="modest", password="modest"))
    postgres.execute(f"GRANT CREATE ON DATABASE {name} TO modest")  # type: ignore[arg-type]
    with caplog.at_level(logging.WARNING):
        JobStore(tmp_path, postgres.url(name, user="modest", password="modest")).close()
    assert caplog.text == ""
