"""A backup of a service and workers at work, the loss of all they had, and a restore elsewhere."""

import io
import os
import shutil
import subprocess
import sys
import threading
import uuid
import zipfile
from contextlib import suppress

import httpx
import pytest

from ultragray.phantom.demo import copy_demo_scene
from ultragray_workers.backup.contents import Folders

from ..waiting import wait_until
from ..workers.jobs.conftest import files_of, store_dataset
from .machine import Machine

WAIT_S = 400.0
STEPS = 1500  # of the training that is interrupted
_STAYING = 3  # jobs of the load that are left to be done
COMMAND = [sys.executable, "-c", "from ultragray_service.cli.app import app; app()"]


def ultragray(*arguments):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def options(folders, url):
    given = ["--data-folder", str(folders.data), "--artifact-folder", str(folders.artifacts)]
    return given if url is None else [*given, "--database-url", url]


def zipped(folder):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for path in folder.rglob("*"):
            if path.is_file():
                archive.write(path, path.relative_to(folder))
    return packed.getvalue()


def train(scene, steps):
    settings = {"steps": steps, "max_gaussians": 40, "batch_size": 2}
    return {"kind": "train", "specification": {"dataset": "tiny", "scene": scene, "settings": settings}}


def render(scene, count):
    sampler = {"kind": "around", "count": count}
    return {"kind": "render", "specification": {"scene": scene, "sampler": sampler, "height": 16, "width": 16}}


def jobs_of(client):
    found = {}
    token = ""
    while True:
        page = client.get("/v1/jobs", params={"page_size": 100, "page_token": token}).json()
        found |= {job["id"]: job for job in page["jobs"]}
        if not (token := page["next_page_token"]):
            return found


def frame_of(client, scene):
    pose = {"position_mm": {"x": 0, "y": 0, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}
    answer = client.post(
        f"/v1/scenes/{scene}/render",
        json={"pose": pose, "height": 32, "width": 32},
        headers={"Accept": "image/png"},
        timeout=WAIT_S,
    )
    assert answer.status_code == 200, answer.text
    return answer.content


class Load:
    """Jobs, scenes and datasets that come and go until the block ends."""

    def __init__(self, url, scene, dataset):
        self._url, self._scene, self._dataset = url, scene, dataset
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self._go, args=(one,)) for one in (self._jobs, self._files)]
        self.rounds = 0

    def __enter__(self):
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def _go(self, act):
        with httpx.Client(base_url=self._url, timeout=WAIT_S) as client:
            while not self._stop.is_set():
                with suppress(httpx.HTTPError):
                    act(client)
                self.rounds += 1

    def _jobs(self, client):
        deleted, cancelled, stays = (client.post("/v1/jobs", json=render("demo", 2)).json().get("id") for _ in range(3))
        client.post(f"/v1/jobs/{deleted}:cancel")
        client.delete(f"/v1/jobs/{deleted}")
        client.post(f"/v1/jobs/{cancelled}:cancel")
        if self.rounds > _STAYING:
            client.post(f"/v1/jobs/{stays}:cancel")

    def _files(self, client):
        name = f"passing-{uuid.uuid4().hex[:6]}"
        client.put(f"/v1/scenes/{name}", content=self._scene)
        client.put(f"/v1/datasets/{name}", content=self._dataset, headers={"Content-Type": "application/zip"})
        client.delete(f"/v1/datasets/{name}")
        client.delete(f"/v1/scenes/{name}")


@pytest.fixture
def machines(tmp_path, monkeypatch):
    made = []

    def make(name, url):
        if url is not None:
            monkeypatch.setenv("ULTRAGRAY_DATABASE_URL", url)
        made.append(Machine(tmp_path / name))
        return made[-1], Folders(made[-1].data, made[-1].artifacts)

    yield make
    for machine in made:
        machine.kill_all()


@pytest.mark.long
def test_service_that_was_lost_at_work_goes_on_elsewhere(machines, new_database, tmp_path):
    url = new_database()
    machine, folders = machines("first", url)
    backups = tmp_path / "backups"
    store_dataset(folders.artifacts, "tiny")
    copy_demo_scene(folders.data / "demo.ugr")
    machine.bring_workers()
    machine.start_without_workers()
    assert machine.http is not None

    with httpx.Client(base_url=machine.http, timeout=WAIT_S) as client:

        def submit(body):
            answer = client.post("/v1/jobs", json=body)
            assert answer.status_code == 201, answer.text
            return answer.json()["id"]

        def is_done(job_id):
            machine.tend()
            return bool(client.get(f"/v1/jobs/{job_id}").json()["state"] == "succeeded")

        finished = [submit(train("made", 20)), submit(render("demo", 3))]
        wait_until(lambda: all(map(is_done, finished)), within_s=WAIT_S, every_s=0.2)
        interrupted = submit(train("long", STEPS))
        told = folders.artifacts / "jobs" / interrupted
        wait_until(lambda: any(told.glob("*/run-*/checkpoint*")), within_s=WAIT_S, every_s=0.1)
        machine.halt_jobs()  # it is at work however long the backup takes
        waiting = [submit(train("next", 30)), submit(render("made", 4))]
        told = jobs_of(client)
        frames = {scene: frame_of(client, scene) for scene in ("demo", "made")}
        scene, dataset = (folders.data / "demo.ugr").read_bytes(), zipped(files_of(folders.artifacts, "tiny"))
        with Load(machine.http, scene, dataset) as load:
            wait_until(lambda: load.rounds > 4, within_s=WAIT_S)
            ultragray("backup", str(backups), *options(folders, url))
            ultragray("backup", str(backups), *options(folders, url), "--keep", "1")
        assert client.get(f"/v1/jobs/{interrupted}").json()["state"] == "running"
    machine.kill_all()
    shutil.rmtree(tmp_path / "first")
    assert ultragray("backup", str(backups), "--verify").count(": whole") == 1

    url = new_database()
    machine, folders = machines("second", url)
    ultragray("restore", str(backups), *options(folders, url))
    machine.start_without_workers()
    assert machine.http is not None
    with httpx.Client(base_url=machine.http, timeout=WAIT_S) as client:
        again = jobs_of(client)
        assert {job: again[job] for job in finished} == {job: told[job] for job in finished}
        assert {again[job]["state"] for job in (interrupted, *waiting)} == {"queued"}
        assert {scene: frame_of(client, scene) for scene in frames} == frames
        assert [one["name"] for one in client.get("/v1/datasets").json()["datasets"]].count("tiny") == 1
        machine.bring_workers()
        unfinished = [job for job, state in again.items() if state["state"] == "queued"]
        assert {interrupted, *waiting} <= set(unfinished)
        wait_until(lambda: machine.tend() or all(map(is_over(client), unfinished)), within_s=WAIT_S, every_s=0.5)
        ended = jobs_of(client)
        assert {job: ended[job]["reason"] for job in unfinished if ended[job]["state"] != "succeeded"} == {}
        assert "going on from a checkpoint" in client.get(f"/v1/jobs/{interrupted}/log").text
        for name in ("long", "next"):
            frame_of(client, name)


def is_over(client):
    return lambda job: client.get(f"/v1/jobs/{job}").json()["state"] in ("succeeded", "failed", "cancelled")
