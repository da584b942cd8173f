"""Datasets and jobs of several hosts over a bucket: each host sees all of them, and a job goes on elsewhere."""

import json
import shutil
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import httpx
import pytest

from ultragray.datasets.released import write_released
from ultragray.datasets.source import load_dataset
from ultragray.learn.training import TrainingConfig, train
from ultragray.phantom.demo import copy_demo_scene

from ..faults.machine import SERVE, WORK, environment
from ..object_storage import AWAY_S
from ..waiting import wait_until
from ..workers.jobs.conftest import tiny_dataset

_START_TIMEOUT_S = 180.0


class Host:
    """Sees nothing of other hosts but the bucket and the database; its data folder has the demo scene."""

    def __init__(self, folder, artifacts, database_url, **settings):
        self.folder, self.data, self.cache = folder, folder / "data", folder / "cache"
        for one in (self.data, self.cache, folder / "logs"):
            one.mkdir(parents=True)
        copy_demo_scene(self.data / "demo.ugr")
        self._environment = environment(
            folder,
            ULTRAGRAY_ARTIFACT_FOLDER=artifacts,
            ULTRAGRAY_CACHE_FOLDER=str(self.cache),
            ULTRAGRAY_DATABASE_URL=database_url,
            ULTRAGRAY_EMBEDDED_WORKER="false",
            **settings,
        )
        self.processes = []

    def serve(self):
        """Starts a service; its addresses of HTTP and gRPC."""
        process, log = self._spawn(SERVE, "service")

        def addresses():
            assert process.poll() is None, self.told()
            for line in log.read_text().splitlines():
                if '"grpc"' in line and line.endswith("}"):
                    record = json.loads(line)
                    return record["http"], record["grpc"]
            return None

        return wait_until(addresses, within_s=_START_TIMEOUT_S)

    def work(self):
        """Starts a worker."""
        return self._spawn(WORK, "worker")[0]

    def kill_all(self):
        """As a loss of power: the processes of jobs die with their workers."""
        for process in self.processes:
            process.kill()
            process.wait()

    def told(self):
        """The ends of the logs, for the message of a test that fails."""
        logs = sorted((self.folder / "logs").iterdir())
        return "\n".join(f"--- {self.folder.name}/{log.name}\n{log.read_text()[-4000:]}" for log in logs)

    def _spawn(self, command, kind):
        path = self.folder / "logs" / f"{kind}-{len(self.processes)}"
        with path.open("ab") as log:
            self.processes.append(subprocess.Popen(command, env=self._environment, stdout=log, stderr=log))
        return self.processes[-1], path


@pytest.fixture
def bucket(new_bucket):
    """The URL of an empty bucket."""
    return new_bucket()


@pytest.fixture
def new_host(bucket, object_proxy, postgres, tmp_path):
    """Makes a host of that name, with a folder of its own."""
    database_url = postgres.create_database()
    hosts = []

    def make(name):
        hosts.append(Host(tmp_path / name, f"{bucket}/artifacts", database_url))
        return hosts[-1]

    yield make
    for host in hosts:
        host.kill_all()


STEPS, SEED = int(500 * AWAY_S), 3  # so many that the training outlasts the time without storage
SETTINGS = {"steps": STEPS, "seed": SEED, "max_gaussians": 40, "batch_size": 2}


def released(folder):
    """The tiny dataset as an archive."""
    write_released(tiny_dataset(), folder)
    return Path(shutil.make_archive(str(folder), "zip", folder)).read_bytes()


def put_dataset(http, content):
    return httpx.put(
        f"{http}/v1/datasets/tiny", content=content, headers={"Content-Type": "application/zip"}, timeout=300
    )


def get(http, path, **options):
    return httpx.get(f"{http}/v1/{path}", timeout=60, **options)


@pytest.mark.long
def test_a_training_goes_on_at_another_host_to_the_same_scene(new_host, object_proxy, tmp_path):
    one, two = new_host("one"), new_host("two")
    (a, _), (b, _) = one.serve(), two.serve()

    def told():
        return one.told() + two.told()

    content = released(tmp_path / "released")
    assert put_dataset(a, content).status_code == 201
    assert [record["name"] for record in get(b, "datasets").json()["datasets"]] == ["tiny"]
    assert put_dataset(b, content).status_code == 200  # it is there already
    assert get(b, "datasets/tiny/contact-sheet").content.startswith(b"\x89PNG")
    assert len(get(b, "datasets/tiny/poses").json()["train"]) == 6

    worker = one.work()
    body = {
        "kind": "train",
        "specification": {"dataset": "tiny", "scene": "made", "settings": SETTINGS, "device": "cpu"},
    }
    job = httpx.post(f"{b}/v1/jobs", json=body, timeout=60).json()["id"]

    def progress(http=b):
        return get(http, f"jobs/{job}").json()["progress"]["step"] or 0

    wait_until(lambda: progress() > STEPS // 20, within_s=240, every_s=0.5)
    object_proxy.away = True  # for a while the storage is away: the work goes on
    time.sleep(AWAY_S)
    assert worker.poll() is None, told()
    object_proxy.away = False
    before = progress()
    wait_until(lambda: progress() > before, within_s=60, every_s=0.5)
    worker.kill()
    worker.wait()
    assert progress() < STEPS, "it was not killed midway"
    assert get(b, f"jobs/{job}/preview").content.startswith(b"\x89PNG")

    two.work()
    found = wait_until(
        lambda: (one := get(a, f"jobs/{job}").json())["state"] in ("succeeded", "failed") and one,
        within_s=400,
        every_s=0.5,
    )
    assert found["state"] == "succeeded", (found, told())
    assert (found["attempts"], found["progress"]["step"]) == (2, STEPS)
    logs = [get(http, f"jobs/{job}/log").text for http in (a, b)]
    assert logs[0] == logs[1]
    assert logs[0].count("training made") == 2
    assert "going on from a checkpoint" in logs[0]

    dataset = replace(load_dataset(tmp_path / "released"), name="tiny")
    undisturbed = train(dataset, TrainingConfig.preset("fast", **SETTINGS)).to_bytes()
    for http in (a, b):
        wait_until(lambda http=http: "made" in get(http, "scenes").text, within_s=60, every_s=0.5)
        assert get(http, f"jobs/{job}/artifacts/made.ugr").content == undisturbed
        rest = get(http, f"jobs/{job}/artifacts/made.ugr", headers={"Range": "bytes=100-"})
        assert (rest.status_code, rest.content) == (206, undisturbed[100:])
        journal = get(http, f"jobs/{job}/artifacts/metrics.jsonl").text.splitlines()
        assert [json.loads(line)["step"] for line in journal] == list(range(1, STEPS + 1))
        assert len(get(http, f"jobs/{job}/curve").json()["points"]) == 500
