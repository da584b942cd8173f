"""A training while it runs: its curve and its preview, over HTTP, with a worker."""

import cv2
import httpx
import numpy as np
import pytest

from ultragray.datasets.released import write_released
from ultragray.learn.training.trainer import CHECKPOINT_FILE, CONFIG_FILE, JOURNAL_FILE
from ultragray_service.views.prepared import MAX_POINTS
from ultragray_workers.jobs.files import CHECKPOINT_NAME, CONFIG_NAME, JOURNAL_NAME

from ...waiting import wait_until
from ..http.test_http_comparison import DATASET
from ..http.test_http_datasets import zipped

STEPS = 40_000  # more than are done here


@pytest.fixture(scope="module")
def http(start_service, tmp_path_factory, artifacts):
    folder = tmp_path_factory.mktemp("dataset")
    write_released(DATASET, folder)
    service = start_service(artifact_folder=artifacts, embedded_worker=True, training_threads=1)
    with httpx.Client(base_url=service.http, timeout=300) as client:
        packed = zipped({path.name: path.read_bytes() for path in folder.iterdir()})
        answer = client.put("/v1/datasets/tiny", content=packed, headers={"Content-Type": "application/zip"})
        assert answer.status_code == 201, answer.text
        yield client


def train(http, scene, **settings):
    body = {"kind": "train", "specification": {"dataset": "tiny", "scene": scene, "settings": settings}}
    answer = http.post("/v1/jobs", json=body)
    assert answer.status_code == 201, answer.text
    return answer.json()["id"]


def test_the_names_of_the_files_of_a_run():
    assert (JOURNAL_NAME, CHECKPOINT_NAME, CONFIG_NAME) == (JOURNAL_FILE, CHECKPOINT_FILE, CONFIG_FILE)


@pytest.mark.long
def test_the_curve_of_a_finished_training_and_of_other_jobs(http):
    job = train(http, "short", steps=30, max_gaussians=50, confidence=False)
    wait_until(lambda: http.get(f"/v1/jobs/{job}").json()["state"] == "succeeded")
    curve = http.get(f"/v1/jobs/{job}/curve").json()
    points = curve["points"]
    assert [point["step"] for point in points] == list(range(1, 31))
    assert set(curve["baselines"]) == {"linear", "in-time", "median"}
    assert all(5.0 < psnr_db < 60.0 for psnr_db in curve["baselines"].values())
    assert any(point["val_psnr_db"] for point in points)
    assert http.get(f"/v1/jobs/{job}/preview").json()["reason"] == "ARTIFACT_NOT_FOUND"
    render = {"kind": "render", "specification": {"scene": "demo", "sampler": {"kind": "training"}}}
    other = http.post("/v1/jobs", json=render).json()["id"]
    assert http.get(f"/v1/jobs/{other}/curve").json() == {"points": [], "baselines": {}}
    assert http.get(f"/v1/jobs/{other}/preview").json()["reason"] == "ARTIFACT_NOT_FOUND"
    assert http.get("/v1/jobs/0123/curve").json()["reason"] == "JOB_NOT_FOUND"


@pytest.mark.long
def test_a_training_is_seen_while_it_runs(http, artifacts):
    job = train(http, "long", steps=STEPS, max_gaussians=50, confidence=False)
    missing = http.get(f"/v1/jobs/{job}/preview").json()
    assert (missing["reason"], missing["field"]) == ("ARTIFACT_NOT_FOUND", "job")

    def curve():
        return http.get(f"/v1/jobs/{job}/curve").json()["points"]

    before = wait_until(curve)
    after = wait_until(lambda: (found := curve())[-1]["step"] > before[-1]["step"] + 600 and found)
    assert len(after) <= MAX_POINTS
    assert [point["step"] for point in after] == sorted({point["step"] for point in after})
    assert after[-1]["loss"] < after[0]["loss"]

    preview = wait_until(lambda: (answer := http.get(f"/v1/jobs/{job}/preview")).status_code == 200 and answer)
    picture = np.asarray(cv2.imdecode(np.frombuffer(preview.content, np.uint8), cv2.IMREAD_UNCHANGED), float)
    assert picture.shape == (512, 1024)
    assert abs(picture[:, :512].mean() - DATASET.val.images[1].mean()) < 1.0
    assert np.corrcoef(picture[:, :512].ravel(), picture[:, 512:].ravel())[0, 1] > 0.2

    assert list((artifacts / "previews").glob(f"{job}-*"))
    http.post(f"/v1/jobs/{job}:cancel")
    wait_until(lambda: http.delete(f"/v1/jobs/{job}").status_code == 204)
    assert not list((artifacts / "previews").iterdir())
