from __future__ import annotations

import re
from datetime import datetime

import httpx
import pytest

from ..conftest import HEIGHT, WIDTH, RunningService, StartService

NAMES = ["demo", "empty", "foreign", "probeless", "second", "truncated"]


def test_health(http: httpx.Client) -> None:
    assert http.get("/v1/health/live").json() == {"status": "live"}
    assert http.get("/v1/health/ready").json()["status"] == "ready"


def test_list_names_every_file_and_what_is_wrong_with_it(http: httpx.Client, service: RunningService) -> None:
    page = http.get("/v1/scenes").json()
    assert [entry["name"] for entry in page["scenes"]] == NAMES
    assert page["next_page_token"] == ""
    entries = {entry["name"]: entry for entry in page["scenes"]}
    demo = entries["demo"]
    assert (demo["gaussian_count"], demo["image_height"], demo["image_width"]) == (400, HEIGHT, WIDTH)
    assert (demo["probe_kind"], demo["metrics"]) == ("linear", {"psnr": 20.5})
    changed_s = datetime.fromisoformat(demo["changed_at"]).timestamp()
    assert abs(changed_s - (service.data_folder / "demo.ugr").stat().st_mtime) <= 1
    assert "probe_kind" not in entries["probeless"]
    assert "error" not in demo
    for name in ("empty", "foreign", "truncated"):
        assert entries[name]["error"]["reason"] == "SCENE_FILE_INVALID"
        assert f"{name}.ugr" in entries[name]["error"]["detail"]


@pytest.mark.parametrize("page_size", [1, 2, 4, 6])
def test_pages_join_to_the_whole_list(http: httpx.Client, page_size: int) -> None:
    names: list[str] = []
    token = ""
    while True:
        page = http.get("/v1/scenes", params={"page_size": page_size, "page_token": token}).json()
        assert len(page["scenes"]) <= page_size
        names += [entry["name"] for entry in page["scenes"]]
        token = page["next_page_token"]
        if not token:
            break
    assert names == NAMES


def test_a_scene_says_all_about_itself(http: httpx.Client, service: RunningService) -> None:
    scene = http.get("/v1/scenes/demo").json()
    assert scene["probe"] == {"kind": "linear", "width_mm": 40.0, "near_mm": 0.0, "far_mm": 40.0}
    assert scene["centre_mm"] == {"x": 0.0, "y": 0.0, "z": 20.0}
    assert scene["bounds"]["min_mm"]["z"] < 20 < scene["bounds"]["max_mm"]["z"]
    assert (scene["image_height"], scene["image_width"], scene["sh_degree"]) == (HEIGHT, WIDTH, 0)
    assert scene["intensity"] == "released"
    assert scene["metrics"] == {"psnr": 20.5}
    assert scene["dataset_name"] == "synthetic"
    assert scene["file_bytes"] == (service.data_folder / "demo.ugr").stat().st_size
    training = scene["training_poses"]
    assert training["count"] == 5
    assert training["position_max_mm"] == {"x": 0.0, "y": 4.0, "z": 0.0}
    assert training["first"]["quaternion"] == {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
    assert training["middle"]["position_mm"]["y"] == 2.0
    assert training["last"]["matrix"][1] == [0.0, 1.0, 0.0, 4.0]


def test_load_and_unload(http: httpx.Client) -> None:
    assert http.post("/v1/scenes/second:load").json() == {"scene": "second", "loaded": True, "loaded_processes": 1}
    assert http.get("/v1/scenes/second").json()["loaded"] is True
    assert http.post("/v1/scenes/second:unload").json()["loaded"] is False
    assert http.post("/v1/scenes/second:unload").status_code == 200
    assert http.get("/v1/scenes/second").json()["loaded"] is False
    assert http.post("/v1/scenes/nowhere:unload").json()["reason"] == "SCENE_NOT_FOUND"


def sample(exposition: str, name: str) -> float:
    """The value of a metric, all its labels together."""
    lines = [line for line in exposition.splitlines() if line.startswith((f"{name} ", f"{name}{{"))]
    assert name in exposition
    return sum(float(line.split()[-1]) for line in lines)


def test_metrics_count_frames_and_keep_the_three_times_apart(http: httpx.Client) -> None:
    identity = {"position_mm": {"x": 0, "y": 0, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}
    before = http.get("/metrics").text
    assert http.post("/v1/scenes/demo/render", json={"poses": [identity] * 3}).status_code == 200
    after = http.get("/metrics").text
    assert sample(after, "ultragray_frames_total") == sample(before, "ultragray_frames_total") + 3
    for stage in ("queue", "render", "encode"):
        name = f"ultragray_{stage}_seconds_count"
        assert sample(after, name) == sample(before, name) + 1
    assert sample(after, "ultragray_processes_alive") == 1
    assert sample(after, "ultragray_process_restarts_total") == 0
    assert sample(after, "ultragray_waiting_frames") == 0
    assert sample(after, "ultragray_loaded_scenes") >= 1
    assert 'ultragray_requests_total{door="http",route="/v1/scenes/{scene}/render",status="200"}' in after


def test_pages_of_allowed_origins_may_call(start_service: StartService) -> None:
    service = start_service(cors_origins="https://console.example")
    asked = {"Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "content-type"}
    for origin, allowed in (("https://console.example", True), ("https://other.example", False)):
        answer = httpx.options(f"{service.http}/v1/scenes/demo/render", headers={"Origin": origin, **asked})
        assert (answer.headers.get("access-control-allow-origin") == origin) is allowed
    answer = httpx.get(f"{service.http}/v1/scenes", headers={"Origin": "https://console.example"}, timeout=60)
    assert "X-Ultragray-Shape" in answer.headers["access-control-expose-headers"]


def test_the_docs_need_nothing_from_outside(http: httpx.Client) -> None:
    page = http.get("/docs").text
    assets = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert len(assets) >= 3
    for asset in assets:
        assert asset.startswith("/docs/static/")
        assert http.get(asset).status_code == 200


@pytest.mark.parametrize("path", ["/v1/health/live", "/v1/health/ready"])
def test_health_answers_head(http: httpx.Client, path: str) -> None:  # what load balancers send
    assert http.head(path).status_code == 200
