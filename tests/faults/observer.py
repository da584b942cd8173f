"""An eye on everything that can be seen from outside while processes are killed."""

import json
import tarfile
import threading
import time
import traceback

import cv2
import httpx
import numpy as np

from ultragray.scene.gaussians import GaussianScene
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.storage.local import FileVersion

from ..workers.jobs.conftest import path_of

_LOOK_EVERY_S = 0.1
FINAL = ("succeeded", "failed", "cancelled")


class Observer:
    """Looks until it is stopped; what was wrong is in `faults`."""

    def __init__(self, machine, store):
        self._machine, self._store = machine, store
        self.known = {}  # the priority asked for, by the id that a submission was answered with
        self.faults = []
        self.jobs = {}
        self.steps_lost = 0  # taken, and taken again from a checkpoint
        self.looks = self.answers = 0
        self._states = {}
        self._scenes = {}
        self._steps = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def stop(self):
        """Returns after the last look."""
        self._stop.set()
        self._thread.join()

    def _run(self):
        while not self._stop.wait(_LOOK_EVERY_S) and len(self.faults) < 5:
            try:
                self._look_at_store()
                self._look_at_service()
                self._look_at_scenes()
                self._look_at_journals()
                self.looks += 1
            except Exception:
                self.faults.append(traceback.format_exc())

    def _wrong(self, told):
        self.faults.append(f"{time.strftime('%H:%M:%S')} {told}")

    def _look_at_store(self):
        known = set(self.known)
        listed, _ = self._store.list(page_size=1000)
        self._check_listing("store", known, [(job.id, job.state.value) for job in listed])
        for job in listed:
            before = self.jobs.get(job.id)
            if before is not None and job.attempts < before.attempts:
                self._wrong(f"attempts went back: {before} -> {job}")
            if job.state is JobState.SUCCEEDED and (before is None or before.state is not JobState.SUCCEEDED):
                self._check_finished(job)
            self.jobs[job.id] = job
        self._check_order(listed)

    def _look_at_service(self):
        if (address := self._machine.http) is None:
            return
        known = set(self.known)
        try:
            with httpx.Client(base_url=address, timeout=60) as client:
                jobs = client.get("/v1/jobs", params={"page_size": 1000})
                scenes = client.get("/v1/scenes")
        except httpx.TransportError:  # it was killed
            return
        if {jobs.status_code, scenes.status_code} != {200}:
            self._wrong(f"{jobs.status_code} {jobs.text[:500]}, {scenes.status_code} {scenes.text[:500]}")
            return
        self._check_listing("service", known, [(job["id"], job["state"]) for job in jobs.json()["jobs"]])
        broken = [scene for scene in scenes.json()["scenes"] if scene.get("error")]
        if broken:
            self._wrong(f"scenes that are served and broken: {broken}")
        self.answers += 1

    def _check_listing(self, where, known, listed):
        """No job is lost or told twice, and what is final stays so."""
        ids = [job_id for job_id, _ in listed]
        if len(set(ids)) != len(ids) or not known <= set(ids):
            self._wrong(f"{where}: {sorted(known)} are known, listed are {ids}")
        for job_id, state in listed:
            before = self._states.get(job_id)
            if before in FINAL and state != before:
                self._wrong(f"{where}: {job_id} was {before} and is {state}")
            self._states[job_id] = state

    def _check_order(self, listed):
        """No job was ever started while another waits that goes first (all were submitted before the first start)."""
        ranks = {job.id: (-self.known.get(job.id, job.priority), job.created_at) for job in listed}
        started = [job for job in listed if job.attempts]
        for waiting in (job for job in listed if not job.attempts):
            for job in started:
                if ranks[job.id] > ranks[waiting.id]:
                    self._wrong(f"{job} was started before {waiting}")

    def _check_finished(self, job):
        """What a job that succeeded has made is there, whole, and its scene is served."""
        for name in job.artifacts:
            check_whole(path_of(self._store.artifact(job.id, name)))
        scene = self._machine.artifacts / "scenes" / f"{job.specification['scene']}.ugr"
        if job.kind == "train" and not scene.is_file():
            self._wrong(f"{job.id} succeeded, its scene is not served")

    def _look_at_scenes(self):
        """Every scene that can be seen loads, and never changes."""
        for path in _scene_files([self._machine.data, self._machine.artifacts / "scenes"]):
            version = FileVersion.of(path)
            if path not in self._scenes:
                GaussianScene.load(path)
            elif self._scenes[path] != version:
                self._wrong(f"{path.name} was replaced")
            self._scenes[path] = version
        if gone := [path.name for path in self._scenes if not path.is_file()]:
            self._wrong(f"scenes are gone: {gone}")

    def _look_at_journals(self):
        """A journal that has become shorter tells how far back a training has gone."""
        for journal in (self._machine.artifacts / "work").glob("*/run/metrics.jsonl"):
            try:
                steps = journal.read_bytes().count(b"\n")
            except FileNotFoundError:  # it has finished
                continue
            job_id = journal.parents[1].stem  # one folder for each attempt
            self.steps_lost += max(0, self._steps.get(job_id, 0) - steps)
            self._steps[job_id] = steps


def _scene_files(folders):
    return [path for folder in folders for path in folder.glob("*.ugr")]


def check_whole(path):
    """Raises where an artifact is not complete."""
    if path.suffix == ".ugr":
        GaussianScene.load(path)
    elif path.suffix == ".npz":
        with np.load(path) as archive:
            assert len(archive["bmode"]) == len(archive["poses"])
    elif path.suffix == ".tar":
        with tarfile.open(path) as tar:
            assert len(tar.getnames()) % 2 == 0
    elif path.suffix == ".png":
        assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED) is not None
    elif path.suffix == ".html":
        assert path.read_text(encoding="utf-8").rstrip().endswith("</html>")
    else:
        assert path.suffix in (".json", ".jsonl")
        text = path.read_text(encoding="utf-8")
        for line in text.splitlines() if path.suffix == ".jsonl" else [text]:
            json.loads(line)
