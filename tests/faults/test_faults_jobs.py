"""Processes killed at random while jobs run: no job is lost, doubled or stuck, and every scene is as it should be.

ULTRAGRAY_FAULT_KILLS (`make test-faults` has 32) and ULTRAGRAY_FAULT_SEED choose how often and when. The server is
killed once more, while all jobs wait and there is no worker.
"""

import json
import os
import random
import tarfile
import time
from collections import Counter
from dataclasses import replace

import grpc
import httpx
import numpy as np
import pytest
from google.protobuf.json_format import ParseDict

from ultragray import GaussianScene, render
from ultragray.datasets.source import load_dataset
from ultragray.learn.training import TrainingConfig, train
from ultragray.phantom.demo import copy_demo_scene
from ultragray_proto.v1 import jobs_pb2, jobs_pb2_grpc
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.store import JobStore

from ..workers.jobs.conftest import files_of, store_dataset
from .machine import Machine
from .observer import Observer

KILLS = int(os.environ.get("ULTRAGRAY_FAULT_KILLS", "3"))
SEED = int(os.environ.get("ULTRAGRAY_FAULT_SEED", "1"))
STEPS = 200 * KILLS  # of the shortest training
TIME_LIMIT_S = 600.0 + 60.0 * KILLS  # forty times what it takes on a machine of its own: others may keep it busy
SOONEST_S, SOON_S = 0.1, 4.0
FRAMES, HEIGHT, WIDTH = 60 * KILLS, 96, 80  # of a rendering

# scene, priority, seed, more steps than the shortest
TRAININGS = [("a", 0, 1, 0), ("b", 5, 2, 40), ("c", 0, 3, 17), ("d", -2, 4, 3), ("e", 5, 5, 21)]
if KILLS < 10:
    del TRAININGS[2:]

POSES = np.tile(np.eye(4), (FRAMES, 1, 1))  # mm
POSES[:, :3, 3] = np.random.default_rng(SEED).normal(0.0, 2.0, (FRAMES, 3))


def training(scene, priority, seed, more):
    settings = {"steps": STEPS + more, "seed": seed, "max_gaussians": 40, "batch_size": 2}
    specification = {"dataset": "tiny", "scene": scene, "settings": settings, "device": "cpu"}
    return {"kind": "train", "request_id": f"train {scene}", "priority": priority, "specification": specification}


def rendering(request_id, priority, format):
    specification = {"scene": "demo", "poses": POSES.tolist(), "height": HEIGHT, "width": WIDTH, "format": format}
    return {"kind": "render", "request_id": request_id, "priority": priority, "specification": specification}


FIRST = [*(training(*values) for values in TRAININGS), rendering("early", 1, "npz")]
LATE = rendering("late", -9, "tar")


def submit(machine, body, over_grpc):
    """The id, and whether the job is new; None where the server is down or not ready."""
    if machine.http is None or machine.grpc is None:
        return None
    if not over_grpc:
        try:
            answer = httpx.post(f"{machine.http}/v1/jobs", json=body, timeout=60)
        except httpx.TransportError:
            return None
        if answer.status_code == 503:
            return None
        assert answer.status_code in (200, 201), answer.text
        return answer.json()["id"], answer.status_code == 201
    specification = dict(body["specification"])
    if "poses" in specification:
        specification["poses"] = [{"matrix": {"values": np.ravel(pose).tolist()}} for pose in specification["poses"]]
    asked = {body["kind"]: specification, "request_id": body["request_id"], "priority": body["priority"]}
    with grpc.insecure_channel(machine.grpc) as channel:
        try:
            told = jobs_pb2_grpc.JobServiceStub(channel).SubmitJob(
                ParseDict(asked, jobs_pb2.SubmitJobRequest()), timeout=20
            )
        except grpc.RpcError as error:
            if error.code() is grpc.StatusCode.UNAVAILABLE:
                return None
            raise
    return told.job.id, told.created


class Killer:
    """Decides when the next process dies: spread over all steps, soon after another, while artifacts are written, or
    in the middle of a rendering.
    """

    def __init__(self, machine, total_steps):
        self._machine, self._chance = machine, random.Random(SEED)
        chance = self._chance
        kinds = [("job", "worker", "server", "template", "all")[number % 5] for number in range(KILLS)]
        moments = [("steps", "soon", "finishing", "rendering")[number % 4] for number in range(KILLS)]
        chance.shuffle(kinds)
        chance.shuffle(moments)
        moments[0] = "steps"
        places = sorted(chance.uniform(0.0, 0.8) * total_steps for _ in range(KILLS))
        self._plan = list(zip(kinds, moments, places, strict=True))
        self._latest = 0.1 * total_steps  # how long artifacts are waited for
        self._due_at = 0.0
        self.done = []

    @property
    def finished(self):
        return len(self.done) == len(self._plan)

    def tend(self, steps_done, jobs):
        """Kills if it is time to."""
        if self.finished or time.monotonic() < self._due_at:
            return
        kind, moment, place = self._plan[len(self.done)]
        if moment == "steps" and steps_done < place:
            return
        if moment == "finishing" and not self._is_finishing() and steps_done < place + self._latest:
            return
        if moment == "rendering" and not any(map(is_rendering, jobs)) and steps_done < place + self._latest:
            return
        if self._machine.strike(kind, self._chance):
            self.done.append((kind, moment))
            soon = not self.finished and self._plan[len(self.done)][1] == "soon"
            self._due_at = time.monotonic() + self._chance.uniform(SOONEST_S, SOON_S if soon else 1.0)

    def _is_finishing(self):
        """Whether a job has begun to write its artifacts and has not said how it ended."""
        folders = (self._machine.artifacts / "work").glob("*/artifacts*")
        return any(not (folder.parent / "outcome.json").exists() for folder in folders)


@pytest.fixture
def machine(tmp_path):
    machine = Machine(tmp_path)
    copy_demo_scene(machine.data / "demo.ugr")
    store_dataset(machine.artifacts, "tiny")
    yield machine
    machine.kill_all()


def is_rendering(job):
    """Whether some frames are done, and others are not."""
    done, frames = job.progress.frames_done or 0, job.progress.frames or 0
    return job.kind == "render" and job.state is JobState.RUNNING and 0 < done < frames


def steps_done(jobs):
    return sum(job.progress.step or 0 for job in jobs.values() if job.kind == "train")


@pytest.mark.long
def test_every_job_ends_as_if_nothing_had_been_killed(machine):
    began = time.monotonic()
    machine.start_without_workers()
    store = JobStore(machine.artifacts, None)
    observer = Observer(machine, store)
    ids = {}
    total_steps = sum(STEPS + more for _, _, _, more in TRAININGS)
    killer = Killer(machine, total_steps)

    def ask(number, body):
        answer = submit(machine, body, over_grpc=number % 2 == 0)
        if answer is not None:
            ids[body["request_id"]] = answer[0]
            observer.known[answer[0]] = body["priority"]

    try:
        for number, body in enumerate(FIRST):
            ask(number, body)
        assert len(ids) == len(FIRST), machine.told()
        machine.bring_workers()
        assert machine.strike("server", random.Random(SEED))

        while len(ids) <= len(FIRST) or any(job.state.value in ("queued", "running") for job in observer.jobs.values()):
            if observer.faults or time.monotonic() - began > TIME_LIMIT_S:
                pytest.fail("\n".join([*observer.faults, *map(str, observer.jobs.values()), machine.told()]))
            done = steps_done(observer.jobs)
            if done > 0.4 * total_steps and LATE["request_id"] not in ids:
                ask(0, LATE)
            killer.tend(done, list(observer.jobs.values()))
            machine.tend()
            time.sleep(0.02)
        while machine.http is None:
            machine.tend()
            time.sleep(0.05)
        again = [submit(machine, body, over_grpc=number % 2 == 1) for number, body in enumerate([*FIRST, LATE])]
        assert again == [(ids[body["request_id"]], False) for body in [*FIRST, LATE]]
        check_artifacts_are_told(machine, observer.jobs)
        assert killer.finished, killer.done
        observer.stop()
        assert not observer.faults, (*observer.faults, machine.told())
        assert machine.stop() == [0, 0], machine.told()
    finally:
        observer.stop()
        machine.kill_all()
        jobs = {request_id: store.get(job_id) for request_id, job_id in ids.items()}
        store.close()
    wall_s = time.monotonic() - began

    assert set(observer.jobs) == set(ids.values())
    assert {request_id: job.state for request_id, job in jobs.items()} == dict.fromkeys(ids, JobState.SUCCEEDED), jobs
    for scene, _, seed, more in TRAININGS:
        check_training(machine, jobs[f"train {scene}"], scene, seed, STEPS + more)
    check_renderings(machine, jobs["early"], jobs["late"])
    check_nothing_is_left(machine)
    kinds = Counter(kind for kind, _ in [("server", "first"), *killer.done])
    moments = Counter(moment for _, moment in killer.done)
    attempts = {request_id: job.attempts for request_id, job in jobs.items()}
    print(  # noqa: T201
        f"\n{len(killer.done) + 1} kills {dict(kinds)}, {dict(moments)}, seed {SEED}: {wall_s:.0f} s; "
        f"{total_steps:,} steps asked for, {observer.steps_lost:,} taken again; attempts {attempts}; "
        f"{observer.looks} looks, {observer.answers} answers of the service"
    )


def artifact_of(machine, job, name):
    (path,) = (machine.artifacts / "jobs" / job.id).glob(f"*/artifacts/{name}")
    return path


def check_artifacts_are_told(machine, jobs):
    """Over HTTP, each artifact is the file of the store."""
    for job in jobs.values():
        for name in job.artifacts:
            answer = httpx.get(f"{machine.http}/v1/jobs/{job.id}/artifacts/{name}", timeout=60)
            assert answer.status_code == 200, answer.text
            assert answer.content == artifact_of(machine, job, name).read_bytes()


def check_training(machine, job, scene, seed, steps):
    """The scene is that of an undisturbed run, byte for byte, and every step was taken once."""
    settings = training(scene, 0, seed, steps - STEPS)["specification"]["settings"]
    dataset = replace(load_dataset(files_of(machine.artifacts, "tiny")), name="tiny")
    undisturbed = train(dataset, TrainingConfig.preset("fast", **settings))
    served = machine.artifacts / "scenes" / f"{scene}.ugr"
    made = GaussianScene.load(served)
    assert made.info.training["step"] == made.info.training["steps"] == steps
    assert (job.progress.step, job.progress.steps) == (steps, steps)
    assert served.read_bytes() == undisturbed.to_bytes()
    assert artifact_of(machine, job, f"{scene}.ugr").read_bytes() == served.read_bytes()
    journal = artifact_of(machine, job, "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["step"] for line in journal] == list(range(1, steps + 1))


def check_renderings(machine, npz, tar):
    """All frames are there, and are those of a direct rendering."""
    scene = GaussianScene.load(machine.data / "demo.ugr")
    direct = render(scene, None, POSES, height=HEIGHT, width=WIDTH, outputs=("bmode",))
    with np.load(artifact_of(machine, npz, "frames.npz")) as archive:
        np.testing.assert_array_equal(archive["poses"], POSES)
        np.testing.assert_array_equal(archive["bmode"], direct.bmode.numpy())
    with tarfile.open(artifact_of(machine, tar, "frames.tar")) as archive_of_files:
        parts = ("bmode.png", "json")
        assert archive_of_files.getnames() == [f"{frame:06d}.{part}" for frame in range(FRAMES) for part in parts]
    assert (npz.progress.frames_done, tar.progress.frames_done) == (FRAMES, FRAMES)


def check_nothing_is_left(machine):
    """No checkpoint and no half-written file outlives its job."""
    assert list((machine.artifacts / "work").iterdir()) == []
    for path in (machine.artifacts / "jobs").rglob("*"):
        is_log = path.name.startswith(("log-", "journal-"))
        assert path.is_dir() or is_log or path.parent.name == "artifacts" or path.name == "demo.ugr", path
    assert sorted(path.name for path in (machine.artifacts / "scenes").iterdir()) == [
        f"{scene}.ugr" for scene, *_ in TRAININGS
    ]
