"""The surroundings fail while jobs run: the database is cut, the artifact folder vanishes, processes are stopped.

No job is lost or fails, and every scene and archive is as if nothing had been. ULTRAGRAY_FAULT_KILLS and
ULTRAGRAY_FAULT_SEED choose how often and when.
"""

import random
import time
from collections import Counter

import pytest

from ultragray.phantom.demo import copy_demo_scene
from ultragray_workers.errors import DatabaseUnavailable
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.store import JobStore

from ..workers.jobs.conftest import store_dataset
from .machine import DEAD_AFTER_S, Machine
from .test_faults_jobs import (
    KILLS,
    LATE,
    SEED,
    STEPS,
    TRAININGS,
    check_nothing_is_left,
    check_renderings,
    check_training,
    rendering,
    submit,
    training,
)

REMOVED_WITHIN_S = 30.0  # a worker removes the folder of a job when the job's end has been told
CUTS = max(4, KILLS // 2)
TIME_LIMIT_S = 600.0 + 60.0 * CUTS
STALL_TIMEOUT_S = 30.0  # longer than a process is stopped here: that one goes on
BODIES = [*(training(*values) for values in TRAININGS), rendering("early", 1, "npz"), LATE]


@pytest.fixture
def machine(tmp_path, postgres):
    machine = Machine(
        tmp_path, ULTRAGRAY_DATABASE_URL=postgres.create_database(), ULTRAGRAY_JOB_STALL_TIMEOUT_S=str(STALL_TIMEOUT_S)
    )
    copy_demo_scene(machine.data / "demo.ugr")
    store_dataset(machine.artifacts, "tiny")
    yield machine
    machine.kill_all()


class Surroundings:
    """All that a job needs beside its own process, and ways to take it away for a while."""

    def __init__(self, machine, postgres):
        self._machine, self._postgres, self._chance = machine, postgres, random.Random(SEED)
        self._kinds = [self.cut_database, self.take_folder, self.stop_worker, self.stop_job]
        self.done = Counter()

    def fail(self):
        """One failure of the next kind, and its end."""
        kind = self._kinds[self.done.total() % len(self._kinds)]
        self.done[kind.__name__] += kind(self._chance.uniform(1.0, 4.0))

    def cut_database(self, seconds):
        self._postgres.stop()
        try:
            self._machine.tend_for(seconds)
        finally:
            self._postgres.start()
        return True

    def take_folder(self, seconds):
        """As a share that is unmounted: an empty folder of its name is there."""
        artifacts = self._machine.artifacts
        away, mountpoint = artifacts.with_name("away"), artifacts.with_name(f"mountpoint-{self.done.total()}")
        artifacts.rename(away)
        artifacts.mkdir()
        self._machine.tend_for(seconds)
        artifacts.rename(mountpoint)
        away.rename(artifacts)
        return True

    def stop_worker(self, seconds):
        return self._machine.stop_for_a_while("worker", self._chance, seconds + DEAD_AFTER_S)

    def stop_job(self, seconds):
        return self._machine.stop_for_a_while("job", self._chance, seconds)


@pytest.mark.long
def test_every_job_ends_as_if_nothing_had_failed(machine, postgres):
    began = time.monotonic()
    machine.start_without_workers()
    store = JobStore(machine.artifacts, machine.database_url)
    surroundings = Surroundings(machine, postgres)
    try:
        ids = {}
        for number, body in enumerate(BODIES):
            answer = submit(machine, body, over_grpc=number % 2 == 0)
            assert answer is not None, machine.told()
            ids[body["request_id"]] = answer[0]
        machine.bring_workers()
        assert machine.strike("server", random.Random(SEED))  # the next one has a worker, too
        due_at = began
        total = sum(STEPS + more for _, _, _, more in TRAININGS)
        while True:
            assert time.monotonic() - began < TIME_LIMIT_S, (surroundings.done, machine.told())
            machine.tend_for(0.5)
            try:
                jobs = {name: store.get(job_id) for name, job_id in ids.items()}
            except DatabaseUnavailable:
                continue
            if all(job.state.is_final for job in jobs.values()):
                break
            place = total * surroundings.done.total() / CUTS
            if surroundings.done.total() < CUTS and steps(jobs) >= place and time.monotonic() > due_at:
                surroundings.fail()
                due_at = time.monotonic() + 1.0
        assert {job.state for job in jobs.values()} == {JobState.SUCCEEDED}, (jobs, machine.told())
        ended = time.monotonic()
        while any((machine.artifacts / "work").iterdir()) and time.monotonic() - ended < REMOVED_WITHIN_S:
            machine.tend_for(0.2)
    finally:
        machine.kill_all()
        store.close()
    for scene, _, seed, more in TRAININGS:
        check_training(machine, jobs[f"train {scene}"], scene, seed, STEPS + more)
    check_renderings(machine, jobs["early"], jobs["late"])
    check_nothing_is_left(machine)
    attempts = {name: job.attempts for name, job in jobs.items()}
    print(  # noqa: T201
        f"\n{surroundings.done.total()} failures {dict(surroundings.done)}, seed {SEED}: "
        f"{time.monotonic() - began:.0f} s; attempts {attempts}"
    )


def steps(jobs):
    return sum(job.progress.step or 0 for job in jobs.values() if job.kind == "train")
