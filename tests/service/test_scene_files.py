"""Scene files over HTTP: looked into, downloaded, imported, deleted."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from ultragray import GaussianScene
from ultragray_service.scene_points import even_selection

from .conftest import DEMO_PROBE, RunningService, StartService, make_scene

RAW = {"Content-Type": "application/octet-stream"}
POSE = {"position_mm": {"x": 0, "y": 1, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("artifacts")


@pytest.fixture(scope="module")
def service(start_service: StartService, artifacts: Path) -> RunningService:
    return start_service(artifact_folder=artifacts, max_dataset_bytes=200_000, max_body_bytes=1024)


@pytest.fixture(scope="module")
def http(service: RunningService) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=service.http, timeout=60) as client:
        yield client


def points_of(answer: httpx.Response) -> tuple[dict[str, object], np.ndarray]:
    length = int.from_bytes(answer.content[:4], "little")
    assert (4 + length) % 8 == 0
    header = json.loads(answer.content[4 : 4 + length])
    return header, np.frombuffer(answer.content[4 + length :], "<f4").reshape(-1, 6)


def test_gaussians_as_points(http: httpx.Client, demo_scene: GaussianScene) -> None:
    answer = http.get("/v1/scenes/demo/gaussians")
    header, points = points_of(answer)
    assert header == {
        "count": 400,
        "fields": ["x", "y", "z", "intensity", "transmittance", "deviation_mm"],
        "total": 400,
    }
    means_mm = demo_scene.means.numpy() * 10 + [0, 0, 20]
    np.testing.assert_allclose(points[:, :3], means_mm, atol=1e-4)
    intensity = (demo_scene.sh0[:, 0, 0].numpy() * 0.28209479 + 1).clip(0.5, 0.999)
    np.testing.assert_allclose(points[:, 3], intensity, atol=1e-5)
    np.testing.assert_allclose(points[:, 4], demo_scene.transmittances.sigmoid().numpy(), atol=1e-5)
    np.testing.assert_allclose(points[:, 5], 10 * demo_scene.scales.exp().mean(dim=1).numpy(), rtol=1e-5)

    few, chosen = points_of(http.get("/v1/scenes/demo/gaussians", params={"limit": 7}))
    assert few["count"] == 7
    np.testing.assert_array_equal(chosen, points[even_selection(400, 7)])
    assert http.get("/v1/scenes/demo/gaussians", params={"limit": 0}).json()["reason"] == "INVALID_ARGUMENT"
    assert http.get("/v1/scenes/nobody/gaussians").json()["reason"] == "SCENE_NOT_FOUND"


@pytest.mark.parametrize(("count", "limit"), [(0, 5), (3, 5), (5, 5), (1000, 7), (7, 1)])
def test_an_even_selection(count: int, limit: int) -> None:
    chosen = even_selection(count, limit)
    assert len(chosen) == min(count, limit) == len(set(chosen.tolist()))
    gaps = np.diff([*chosen, count])
    assert not len(chosen) or gaps.max() - gaps.min() <= 1


def test_training_poses(http: httpx.Client, demo_scene: GaussianScene) -> None:
    poses = np.array(http.get("/v1/scenes/demo/training-poses").json()["poses"])
    np.testing.assert_array_equal(poses.reshape(-1, 4, 4), demo_scene.training_poses)


def test_the_life_of_an_imported_scene(http: httpx.Client, artifacts: Path) -> None:
    sent = make_scene(probe=DEMO_PROBE, seed=5).to_bytes()
    answer = http.put("/v1/scenes/sent", content=sent, headers=RAW)
    assert answer.status_code == 201, answer.text
    assert (answer.json()["name"], answer.json()["gaussian_count"]) == ("sent", 400)
    assert "sent" in [scene["name"] for scene in http.get("/v1/scenes").json()["scenes"]]

    whole = http.get("/v1/scenes/sent/file")
    assert whole.content == sent
    assert 'filename="sent.ugr"' in whole.headers["content-disposition"]
    part = http.get("/v1/scenes/sent/file", headers={"Range": "bytes=10-19"})
    assert (part.status_code, part.content) == (206, sent[10:20])

    again = http.put("/v1/scenes/sent", content=sent, headers=RAW)
    assert (again.status_code, again.json()["reason"]) == (409, "SCENE_EXISTS")
    assert http.post("/v1/scenes/sent/render", json={"pose": POSE}).status_code == 200
    assert http.get("/v1/scenes/sent").json()["loaded"]
    assert {entry["name"]: entry["removable"] for entry in http.get("/v1/scenes").json()["scenes"]} == {
        "demo": False,
        "sent": True,
    }

    assert http.delete("/v1/scenes/sent").status_code == 204
    assert http.get("/v1/scenes/sent").json()["reason"] == "SCENE_NOT_FOUND"
    assert http.delete("/v1/scenes/sent").json()["reason"] == "SCENE_NOT_FOUND"
    assert http.get("/v1/statistics").json()["loaded_scenes"] == 0
    assert not list((artifacts / "scenes").iterdir())


def test_what_is_no_scene_is_refused_and_leaves_nothing(http: httpx.Client, artifacts: Path) -> None:
    whole = make_scene(probe=DEMO_PROBE).to_bytes()
    damaged = bytearray(whole)
    damaged[-200:] = b"\xff" * 200  # a header that is well, and numbers that are none
    for content, detail in (
        (whole[:-100], "the body"),
        (b"\x89PNG no scene", "the body"),
        (bytes(damaged), "the body"),
    ):
        answer = http.put("/v1/scenes/bad", content=content, headers=RAW)
        problem = answer.json()
        assert (answer.status_code, problem["reason"], problem["field"]) == (422, "SCENE_FILE_INVALID", "body")
        assert detail in problem["detail"]
        assert str(artifacts) not in problem["detail"]
    announced = http.put("/v1/scenes/bad", content=b"\0" * 200_001, headers=RAW)
    assert (announced.status_code, announced.json()["reason"]) == (413, "UPLOAD_TOO_LARGE")

    def blocks() -> Iterator[bytes]:
        for _ in range(3):
            yield b"\0" * 100_000

    assert http.put("/v1/scenes/bad", content=blocks(), headers=RAW).status_code == 413
    assert http.put("/v1/scenes/.bad", content=whole, headers=RAW).json()["reason"] == "INVALID_ARGUMENT"
    assert not list((artifacts / "scenes").glob("*"))
    assert not list((artifacts / "scenes").glob(".*"))


def test_scenes_of_the_data_folder_stay(http: httpx.Client, data_folder: Path) -> None:
    answer = http.delete("/v1/scenes/demo")
    assert (answer.status_code, answer.json()["reason"]) == (403, "SCENE_READ_ONLY")
    assert (data_folder / "demo.ugr").exists()
    taken = http.put("/v1/scenes/demo", content=make_scene().to_bytes(), headers=RAW)
    assert taken.json()["reason"] == "SCENE_EXISTS"
