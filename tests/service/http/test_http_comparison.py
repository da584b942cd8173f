"""A scene beside the held-out frames of its dataset, and the frames and poses of a dataset."""

import time
from dataclasses import replace

import cv2
import httpx
import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.released import write_released
from ultragray.phantom.demo import DEMO_FILE
from ultragray.scene.info import read_header
from ultragray_proto.v1 import datasets_pb2, datasets_pb2_grpc
from ultragray_workers.views import PICTURES

from ...waiting import Deadline
from ..conftest import make_scene
from .test_http_datasets import zipped

RAW = {"Content-Type": "application/octet-stream"}
PROBE = LinearProbe(40.0, 0.0, 40.0)
WAIT_S = 300.0


def sweep(count, offset_mm):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = np.arange(count) + offset_mm
    images = np.broadcast_to(20 + 8 * np.arange(16, dtype=np.uint8), (count, 24, 16)) + np.arange(
        count, dtype=np.uint8
    ).reshape(-1, 1, 1)
    return Sweep(images, poses, PROBE, np.arange(count), "sweep")


DATASET = Dataset("tiny", sweep(6, 0.0), sweep(3, 0.5))


def scene_of(dataset, seed=3):
    scene = make_scene(probe=PROBE, seed=seed)
    scene.info = replace(scene.info, dataset_name=dataset.name, dataset_sha256=dataset.sha256)
    return scene


@pytest.fixture(scope="module")
def service(start_service, artifacts):
    return start_service(artifact_folder=artifacts)


def upload(client, name, dataset, folder):
    write_released(dataset, folder)
    packed = zipped({path.name: path.read_bytes() for path in folder.iterdir()})
    answer = client.put(f"/v1/datasets/{name}", content=packed, headers={"Content-Type": "application/zip"})
    assert answer.status_code == 201, answer.text


@pytest.fixture(scope="module")
def http(service, tmp_path_factory):
    with httpx.Client(base_url=service.http, timeout=300) as client:
        for dataset in (DATASET, replace(DATASET, name="whole", val=DATASET.val.select(np.arange(0)))):
            upload(client, dataset.name, dataset, tmp_path_factory.mktemp("dataset"))
            client.put(f"/v1/scenes/of-{dataset.name}", content=scene_of(dataset).to_bytes(), headers=RAW)
        yield client


def finished(http, scene):
    end = Deadline(WAIT_S)
    while not end.passed:
        found = http.get(f"/v1/scenes/{scene}/comparison").json()
        if found["state"] != "running":
            return found
        assert 0.0 <= found["progress"] <= 1.0
        time.sleep(0.1)
    raise AssertionError(f"not compared within {WAIT_S} s")


def picture(answer):
    assert answer.headers["content-type"] == "image/png", answer.text
    return np.asarray(cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED))


def assert_revalidated(http, path):
    """Who has it is not sent it again."""
    whole = http.get(path)
    assert whole.headers["cache-control"] == "private, no-cache"
    again = http.get(path, headers={"If-None-Match": whole.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_poses_and_frames_of_a_dataset(http):
    poses = http.get("/v1/datasets/tiny/poses").json()
    for part, own in (("train", DATASET.train), ("val", DATASET.val)):
        np.testing.assert_allclose(np.reshape(poses[part], (-1, 4, 4)), own.poses, atol=1e-9)
        frame = picture(http.get(f"/v1/datasets/tiny/frames/{part}/1"))
        assert frame.shape == (512, 512)  # 40 mm by 40 mm
        assert abs(frame.mean() - own.images[1].mean()) < 1.0
        assert_revalidated(http, f"/v1/datasets/tiny/frames/{part}/1")
    assert_revalidated(http, "/v1/datasets/tiny/poses")
    for path, status in (("train/6", 404), ("val/3", 404), ("other/0", 422), ("val/-1", 422)):
        assert http.get(f"/v1/datasets/tiny/frames/{path}").status_code == status
    assert http.get("/v1/datasets/nobody/poses").json()["reason"] == "DATASET_NOT_FOUND"


@pytest.mark.long
def test_a_scene_is_compared_with_the_frames_held_out_from_it(http, artifacts):
    assert http.get("/v1/scenes/of-tiny/comparison/0/truth.png").json()["reason"] == "ARTIFACT_NOT_FOUND"
    found = finished(http, "of-tiny")
    assert (found["state"], found["dataset"], found["error"]) == ("ready", "tiny", None)
    assert [frame["index"] for frame in found["frames"]] == [0, 1, 2]
    pictures = {
        what: picture(http.get(f"/v1/scenes/of-tiny/comparison/1/{what}.png")).astype(float) for what in PICTURES
    }
    assert_revalidated(http, "/v1/scenes/of-tiny/comparison/1/truth.png")
    expected = np.minimum(3.0 * np.abs(pictures["truth"] - pictures["rendering"]), 255)
    assert np.abs(pictures["difference"] - expected).mean() < 15.0  # they were enlarged after the difference
    error = np.mean((pictures["truth"] - pictures["rendering"]) ** 2) / 255.0**2
    assert abs(-10 * np.log10(error) - found["frames"][1]["psnr_db"]) < 3.0
    assert found["frames"][1]["median_psnr_db"] != found["frames"][1]["psnr_db"]
    shown, true = (np.sort(pictures[what], axis=None) / 255.0 for what in ("rendering", "truth"))
    assert abs(np.abs(shown - true).mean() - found["frames"][1]["histogram_distance"]) < 0.02
    (kept,) = (artifacts / "comparisons").iterdir()
    assert kept.name.endswith(DATASET.sha256)
    pixels = len(PICTURES) * DATASET.val.images.size
    assert sum(path.stat().st_size for path in kept.glob("*.npy")) < pixels + 3 * 1024
    before = kept.stat().st_ino
    assert finished(http, "of-tiny") == found
    assert kept.stat().st_ino == before


def test_what_cannot_be_compared_says_why(http):
    missing = http.get("/v1/scenes/demo/comparison").json()
    assert (missing["reason"], missing["field"]) == ("DATASET_NOT_FOUND", "scene")
    assert "'synthetic'" in missing["detail"]
    found = finished(http, "of-whole")
    assert (found["state"], found["error"]) == ("failed", "DATASET_INVALID")
    assert "hold some out" in found["reason"]
    assert http.get("/v1/scenes/nobody/comparison").json()["reason"] == "SCENE_NOT_FOUND"


def made_of(dataset, artifacts):
    return len([*artifacts.glob(f"dataset-views/*{dataset.sha256}"), *artifacts.glob(f"comparisons/*{dataset.sha256}")])


@pytest.mark.long
def test_nothing_stays_of_a_deleted_dataset(http, service, artifacts, tmp_path):
    doomed = Dataset("doomed", sweep(5, 0.0), sweep(2, 0.5))
    upload(http, "doomed", doomed, tmp_path / "doomed")
    upload(http, "same", doomed, tmp_path / "same")
    http.put("/v1/scenes/of-doomed", content=scene_of(doomed).to_bytes(), headers=RAW)
    http.get("/v1/datasets/doomed/poses")
    finished(http, "of-doomed")
    assert http.delete("/v1/datasets/doomed").status_code == 204
    assert made_of(doomed, artifacts) == 2
    with service.channel() as channel:
        datasets_pb2_grpc.DatasetServiceStub(channel).DeleteDataset(datasets_pb2.DeleteDatasetRequest(dataset="same"))
    assert made_of(doomed, artifacts) == 0


def test_what_was_made_of_the_demo_scene_outlives_a_restart(start_service, tmp_path):
    demo, gone = (
        tmp_path / "artifacts" / "comparisons" / f"4-{'0' * 64}-{sha256}"
        for sha256 in (read_header(DEMO_FILE).info.dataset_sha256, "f" * 64)
    )
    for folder in (demo, gone):
        folder.mkdir(parents=True)
    start_service(artifact_folder=tmp_path / "artifacts")
    assert demo.is_dir()  # its dataset is simulated: nobody uploads it
    assert not gone.exists()
