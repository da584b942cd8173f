"""Datasets and jobs of several hosts over a bucket: each host sees all of them, and a job goes on elsewhere."""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
import time
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
import pytest

from ultragray.datasets.released import write_released
from ultragray.datasets.source import load_dataset
from ultragray.learn.training import TrainingConfig, train
from ultragray_proto.v1 import jobs_pb2, jobs_pb2_grpc
from ultragray_workers.storage.location import open_storage

from ..object_storage import AWAY_S, FaultyProxy
from ..waiting import wait_until
from ..workers.jobs.conftest import tiny_dataset
from .host import Host

STEPS, SEED = int(500 * AWAY_S), 3  # so many that the training outlasts the time without storage
SETTINGS = {"steps": STEPS, "seed": SEED, "max_gaussians": 40, "batch_size": 2}

NewHost = Callable[[str], Host]


def released(folder: Path) -> bytes:
    """The tiny dataset as an archive."""
    write_released(tiny_dataset(), folder)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.write(path, path.relative_to(folder))
    return packed.getvalue()


def put_dataset(http: str, content: bytes) -> httpx.Response:
    return httpx.put(
        f"{http}/v1/datasets/tiny", content=content, headers={"Content-Type": "application/zip"}, timeout=300
    )


def get(http: str, path: str, **options: Any) -> httpx.Response:
    return httpx.get(f"{http}/v1/{path}", timeout=60, **options)


@pytest.mark.long
def test_a_training_goes_on_at_another_host_to_the_same_scene(
    new_host: NewHost, object_proxy: FaultyProxy, tmp_path: Path
) -> None:
    one, two = new_host("one"), new_host("two")
    (a, _), (b, _) = one.serve(), two.serve()

    def told() -> str:
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

    def progress(http: str = b) -> int:
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


@pytest.mark.long
@pytest.mark.slow
def test_a_rendering_is_made_on_one_host_and_downloaded_from_another(new_host: NewHost, bucket: str) -> None:
    one, two = new_host("one"), new_host("two")
    http, rpc = one.serve()
    two.work()
    poses = np.tile(np.eye(4), (5, 1, 1)).tolist()
    specification = {"scene": "demo", "poses": poses, "height": 48, "width": 40, "format": "tar"}
    body = {"kind": "render", "specification": specification}
    job = httpx.post(f"{http}/v1/jobs", json=body, timeout=60).json()["id"]

    def ended() -> dict[str, Any] | None:
        found: dict[str, Any] = get(http, f"jobs/{job}").json()
        return found if found["state"] in ("succeeded", "failed") else None

    found = wait_until(ended, within_s=240, every_s=0.5)
    assert (found["state"], found["progress"]["frames_done"]) == ("succeeded", 5), (found, one.told(), two.told())
    whole = get(http, f"jobs/{job}/artifacts/frames.tar").content
    with tarfile.open(fileobj=io.BytesIO(whole)) as archive:
        assert len(archive.getnames()) == 10
    with grpc.insecure_channel(rpc) as channel:
        stub = jobs_pb2_grpc.JobServiceStub(channel)
        asked = jobs_pb2.DownloadArtifactRequest(job=job, name="frames.tar", offset=1000)
        assert b"".join(chunk.data for chunk in stub.DownloadArtifact(asked, timeout=60)) == whole[1000:]

    storage = open_storage(f"{bucket}/artifacts")
    assert [entry.key for entry in storage.entries(f"jobs/{job}") if entry.key.endswith("demo.ugr")]
    assert httpx.delete(f"{http}/v1/jobs/{job}", timeout=60).status_code == 204
    assert list(storage.entries(f"jobs/{job}")) == []
    assert not list(two.cache.rglob(job)), "the host of the worker keeps nothing of it"


@pytest.mark.long
def test_hosts_make_the_shards_of_a_batch_together(new_host: NewHost, bucket: str, object_proxy: FaultyProxy) -> None:
    one, two = new_host("one"), new_host("two")
    http, _ = one.serve()
    workers = [one.work(), two.work()]
    sampler = {"kind": "around", "count": 6_000, "seed": SEED}
    specification = {"scene": "demo", "sampler": sampler, "height": 16, "width": 12, "shard_frames": 250}
    job = httpx.post(f"{http}/v1/jobs", json={"kind": "render", "specification": specification}, timeout=60).json()
    job = job["id"]

    def told() -> str:
        return one.told() + two.told()

    def found() -> dict[str, Any]:
        return dict(get(http, f"jobs/{job}").json())

    wait_until(lambda: found()["progress"]["frames_done"], within_s=240, every_s=0.2)
    object_proxy.away = True
    time.sleep(AWAY_S)
    object_proxy.away = False
    workers[0].kill()
    ended = wait_until(lambda: (it := found())["state"] in ("succeeded", "failed") and it, within_s=400, every_s=0.5)
    assert ended["state"] == "succeeded", (ended, told())
    manifest = get(http, f"jobs/{job}/artifacts/manifest.json").json()
    assert sum(shard["frames"] for shard in manifest["shards"]) == 6_000
    keys: list[str] = []
    for shard in manifest["shards"]:
        content = get(http, f"jobs/{job}/artifacts/{shard['file']}").content
        assert hashlib.sha256(content).hexdigest() == shard["sha256"]
        with tarfile.open(fileobj=io.BytesIO(content)) as tar:
            keys += [name.partition(".")[0] for name in tar.getnames() if name.endswith("bmode.npy")]
    assert len(keys) == len(set(keys)) == 6_000
    assert httpx.delete(f"{http}/v1/jobs/{job}", timeout=60).status_code == 204
    left = [entry.key for entry in open_storage(f"{bucket}/artifacts").entries(f"jobs/{job}")]
    assert left == []
