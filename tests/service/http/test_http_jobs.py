"""Jobs over HTTP against a real service. Without a worker they stay queued; progress is told where a worker runs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import httpx
import pytest
from pydantic import TypeAdapter

from ultragray_service.http.bodies import SPECIFICATIONS
from ultragray_workers.jobs.kinds import Specification

from ...waiting import wait_until
from ..conftest import RunningService, StartService

RENDER = {"kind": "render", "specification": {"scene": "demo", "sampler": {"kind": "training"}}}
WAIT_S = 120.0


@pytest.fixture(scope="module")
def jobs_service(start_service: StartService, tmp_path_factory: pytest.TempPathFactory) -> RunningService:
    """A service without a worker: what is submitted waits."""
    return start_service(artifact_folder=tmp_path_factory.mktemp("artifacts"), embedded_worker=False)


@pytest.fixture(scope="module")
def client(jobs_service: RunningService) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=jobs_service.http, timeout=120) as client:
        yield client


def submit(client: httpx.Client, **changes: Any) -> dict[str, Any]:
    answer = client.post("/v1/jobs", json=RENDER | changes)
    assert answer.status_code == 201, answer.text
    job: dict[str, Any] = answer.json()
    return job


def problem(answer: httpx.Response) -> tuple[int, str, str | None]:
    document = answer.json()
    assert answer.headers["content-type"] == "application/problem+json"
    return answer.status_code, document["reason"], document["field"]


def test_a_submitted_job_waits_and_tells_what_it_is(client: httpx.Client) -> None:
    job = submit(client, priority=3)
    assert (job["state"], job["kind"], job["priority"], job["attempts"]) == ("queued", "render", 3, 0)
    assert job["specification"]["scene"] == "demo"
    assert job["started_at"] is job["finished_at"] is job["reason"] is job["request_id"] is None
    assert job["artifacts"] == []
    assert {name: value for name, value in job["progress"].items() if value is not None} == {
        "waits_for": "a worker: none is running"
    }
    assert client.get(f"/v1/jobs/{job['id']}").json() == job


def test_a_job_that_no_worker_can_take_says_what_it_asks_for_when_it_is_submitted(client: httpx.Client) -> None:
    asked = {"device": "cuda", "min_memory_gb": 16, "worker_labels": {"site": "lab1"}}
    job = submit(client, specification=RENDER["specification"] | asked)
    assert {name: job["specification"][name] for name in asked} == asked
    assert job["progress"]["waits_for"] == (
        "a worker with a GPU of at least 16 GB and the label site=lab1: none is running"
    )


def test_a_render_job_is_estimated_and_not_submitted(client: httpx.Client) -> None:
    before = client.get("/v1/jobs").json()["jobs"]
    sampler = {"kind": "around", "count": 300}
    asked = {"scene": "demo", "sampler": sampler, "height": 32, "width": 16, "outputs": ["bmode", "echo"]}
    found = client.post("/v1/jobs:estimate", json={"kind": "render", "specification": asked | {"dtype": "float32"}})
    assert found.status_code == 200, found.text
    told = found.json()
    assert (told["frames"], told["files"], told["height"], told["width"]) == (300, 1, 32, 16)
    assert told["bytes"] == 300 * 32 * 16 * (4 + 4)
    assert len(told["poses"]) == 256
    assert told["seconds"] > 0.0
    assert client.get("/v1/jobs").json()["jobs"] == before


def test_the_estimate_of_a_batch_in_shards_counts_its_files(client: httpx.Client) -> None:
    sampler = {"kind": "around", "count": 250_000}
    asked = {"scene": "demo", "sampler": sampler, "height": 16, "width": 16}
    told = client.post("/v1/jobs:estimate", json={"kind": "render", "specification": asked}).json()
    assert (told["frames"], told["files"], len(told["poses"])) == (250_000, 50, 256)
    assert told["bytes"] == 250_000 * (16 * 16 + 2048)


@pytest.mark.parametrize(
    ("kind", "specification", "expected"),
    [
        ("train", {"dataset": "a", "scene": "b"}, (422, "INVALID_ARGUMENT", "kind")),
        ("render", {"scene": "none", "sampler": {"kind": "training"}}, (404, "SCENE_NOT_FOUND", "specification.scene")),
        (
            "render",
            {"scene": "demo", "sampler": {"kind": "fan", "tilt_deg": 90, "step_deg": 1e-3}},
            (422, "INVALID_ARGUMENT", "specification.step_deg"),
        ),
    ],
)
def test_what_cannot_be_estimated(
    client: httpx.Client, kind: str, specification: dict[str, Any], expected: tuple[int, str, str]
) -> None:
    assert problem(client.post("/v1/jobs:estimate", json={"kind": kind, "specification": specification})) == expected


def test_poses_are_counted_not_repeated(client: httpx.Client) -> None:
    pose = [[1, 0, 0, 0], [0, 1, 0, 2.5], [0, 0, 1, 0], [0, 0, 0, 1]]
    job = submit(client, specification={"scene": "demo", "poses": [pose, pose], "height": 16, "width": 8})
    assert job["specification"]["pose_count"] == 2
    assert "poses" not in job["specification"]


def test_the_same_request_id_gives_the_same_job_and_another_body_a_conflict(client: httpx.Client) -> None:
    body = RENDER | {"request_id": "mine/1"}
    first, again = client.post("/v1/jobs", json=body), client.post("/v1/jobs", json=body)
    assert (first.status_code, again.status_code) == (201, 200)
    assert first.json() == again.json()
    assert first.json()["request_id"] == "mine/1"
    assert problem(client.post("/v1/jobs", json=body | {"priority": 1})) == (409, "REQUEST_ID_CONFLICT", "request_id")


@pytest.mark.parametrize(
    ("body", "status", "reason", "field"),
    [
        ({"specification": {"scene": "demo"}}, 422, "INVALID_ARGUMENT", "kind"),
        (RENDER | {"kind": "bake"}, 422, "INVALID_ARGUMENT", "kind"),
        (RENDER | {"urgent": True}, 422, "INVALID_ARGUMENT", "urgent"),
        (RENDER | {"priority": 1001}, 422, "INVALID_ARGUMENT", "priority"),
        (RENDER | {"priority": "1"}, 422, "INVALID_ARGUMENT", "priority"),
        (RENDER | {"request_id": ""}, 422, "INVALID_ARGUMENT", "request_id"),
        ({"kind": "render", "specification": {"scene": "demo"}}, 422, "INVALID_ARGUMENT", "specification.poses"),
        ({"kind": "render", "specification": {"kind": "train"}}, 422, "INVALID_ARGUMENT", "specification.kind"),
        (
            {"kind": "render", "specification": {"scene": "demo", "sampler": {"kind": "around", "count": 0}}},
            422,
            "INVALID_ARGUMENT",
            "specification.sampler.count",
        ),
        (
            {"kind": "render", "specification": {"scene": "demo", "poses": [[[1, 2], [3, 4]]]}},
            422,
            "INVALID_POSE",
            "specification.poses",
        ),
        (
            {"kind": "render", "specification": {"scene": "gone", "sampler": {"kind": "training"}}},
            404,
            "SCENE_NOT_FOUND",
            "specification.scene",
        ),
        (
            {"kind": "train", "specification": {"dataset": "gone", "scene": "new"}},
            404,
            "DATASET_NOT_FOUND",
            "specification.dataset",
        ),
        ({"kind": "train", "specification": {"dataset": "gone"}}, 422, "INVALID_ARGUMENT", "specification.scene"),
        (
            {"kind": "train", "specification": {"dataset": "gone", "scene": "new", "settings": {"stepz": 3}}},
            422,
            "INVALID_ARGUMENT",
            "specification.settings.stepz",
        ),
    ],
)
def test_what_cannot_be_run_is_refused_by_name(
    client: httpx.Client, body: dict[str, Any], status: int, reason: str, field: str
) -> None:
    assert problem(client.post("/v1/jobs", json=body)) == (status, reason, field)


def test_a_body_that_is_no_json_is_refused(client: httpx.Client) -> None:
    answer = client.post("/v1/jobs", content=b"kind=render", headers={"Content-Type": "text/plain"})
    assert problem(answer) == (415, "UNSUPPORTED_MEDIA_TYPE", "Content-Type")


@pytest.mark.parametrize(
    ("method", "route"),
    [
        ("GET", ""),
        ("POST", ":cancel"),
        ("POST", ":retry"),
        ("DELETE", ""),
        ("GET", "/log"),
        ("GET", "/events"),
        ("GET", "/artifacts/a"),
    ],
)
def test_every_route_says_that_there_is_no_such_job(client: httpx.Client, method: str, route: str) -> None:
    for name in ("0" * 24, "..", "%2e%2e%2f", "x" * 300):
        assert client.request(method, f"/v1/jobs/{name}{route}").status_code == 404
    assert problem(client.request(method, f"/v1/jobs/{'0' * 24}{route}")) == (404, "JOB_NOT_FOUND", "job")


def test_pages_join_to_the_whole_list_newest_first(client: httpx.Client) -> None:
    made = [submit(client)["id"] for _ in range(5)]
    found: list[str] = []
    token = ""
    while True:
        page = client.get("/v1/jobs", params={"page_size": 2, "page_token": token, "state": "queued"}).json()
        found += [job["id"] for job in page["jobs"]]
        token = page["next_page_token"]
        if not token:
            break
    assert found[:5] == made[::-1]
    assert len(set(found)) == len(found)
    whole = client.get("/v1/jobs", params={"kind": "render", "page_size": 1000}).json()
    assert set(found) <= {job["id"] for job in whole["jobs"]}
    assert client.get("/v1/jobs", params={"kind": "train"}).json() == {"jobs": [], "next_page_token": ""}
    assert problem(client.get("/v1/jobs", params={"page_token": "made-up"}))[1:] == ("INVALID_ARGUMENT", "page_token")
    assert problem(client.get("/v1/jobs", params={"state": "asleep"}))[1:] == ("INVALID_ARGUMENT", "state")


def test_cancel_is_idempotent_and_retry_makes_a_successor(client: httpx.Client) -> None:
    job = submit(client)
    assert problem(client.post(f"/v1/jobs/{job['id']}:retry")) == (409, "JOB_NOT_FINISHED", "job")
    for _ in range(2):
        cancelled = client.post(f"/v1/jobs/{job['id']}:cancel")
        assert (cancelled.status_code, cancelled.json()["state"]) == (200, "cancelled")
    retried = client.post(f"/v1/jobs/{job['id']}:retry")
    assert retried.status_code == 201
    again = client.post(f"/v1/jobs/{job['id']}:retry")
    assert (again.status_code, again.json()) == (200, retried.json())
    assert (retried.json()["state"], retried.json()["retry_of"]) == ("queued", job["id"])
    assert retried.json()["id"] != job["id"]


def test_a_finished_job_is_deleted_and_others_are_not(client: httpx.Client) -> None:
    route = f"/v1/jobs/{submit(client)['id']}"
    assert problem(client.delete(route)) == (409, "JOB_IN_USE", "job")
    client.post(f"{route}:cancel")
    deleted = client.delete(route)
    assert (deleted.status_code, deleted.content) == (204, b"")
    for answer in (client.get(route), client.delete(route)):
        assert problem(answer) == (404, "JOB_NOT_FOUND", "job")


def test_jobs_are_counted_for_prometheus(start_service: StartService, tmp_path: Path) -> None:
    service = start_service(artifact_folder=tmp_path, embedded_worker=False)
    queued, failed = (f'ultragray_jobs{{state="{state}"}} ' for state in ("queued", "failed"))
    with httpx.Client(base_url=service.http, timeout=WAIT_S) as client:
        wait_until(lambda: f"{queued}0.0" in client.get("/metrics").text)
        submit(client)
        wait_until(lambda: f"{queued}1.0" in client.get("/metrics").text)
        assert f"{failed}0.0" in client.get("/metrics").text


def test_a_job_that_waits_has_an_empty_log_and_no_artifacts(client: httpx.Client) -> None:
    job = submit(client)
    log = client.get(f"/v1/jobs/{job['id']}/log")
    assert (log.status_code, log.text) == (200, "")
    assert log.headers["content-type"].startswith("text/plain")
    assert problem(client.get(f"/v1/jobs/{job['id']}/artifacts/..%2fjob.json"))[0] == 404
    answer = client.get(f"/v1/jobs/{job['id']}/artifacts/metrics.json")
    assert problem(answer) == (404, "ARTIFACT_NOT_FOUND", "name")


def events(lines: Iterator[str]) -> Iterator[tuple[str, str]]:
    """(name, data) of each server-sent event."""
    name, data = "", []
    for line in lines:
        field, _, value = line.partition(": ")
        if field == "event":
            name = value
        elif field == "data":
            data.append(value)
        elif not line and name:
            yield name, "\n".join(data)
            name, data = "", []


def test_a_watcher_that_goes_away_is_let_go(client: httpx.Client, jobs_service: RunningService) -> None:
    route = f"/v1/jobs/{submit(client)['id']}/events"
    with client.stream("GET", route) as answer:
        lines = answer.iter_lines()
        assert [next(lines) for _ in range(3)] == ["retry: 1000", "", "event: progress"]
        assert not [line for line in jobs_service.log() if line.get("path") == route]
    wait_until(lambda: [line for line in jobs_service.log() if line.get("path") == route])  # logged when it has ended


def test_each_kind_has_a_documented_specification() -> None:
    for model, (kind, taken) in zip(SPECIFICATIONS, Specification.members.items(), strict=True):
        assert model.__name__ == f"{kind.title()}Specification"
        schema = TypeAdapter(model).json_schema()
        assert set(schema["properties"]) == {field.name for field in fields(taken)} - {"kind"}
        assert set(schema["required"]) == {"dataset", "scene"} & set(schema["properties"])


def test_a_full_queue_refuses_and_a_stopping_service_ends_the_events_at_once(
    start_service: StartService, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("artifacts")
    service = start_service(artifact_folder=folder, embedded_worker=False, job_queue_limit=1)
    with httpx.Client(base_url=service.http, timeout=WAIT_S) as client:
        job = submit(client, request_id="kept")
        full = client.post("/v1/jobs", json=RENDER)
        assert problem(full) == (429, "JOB_QUEUE_FULL", None)
        assert full.headers["retry-after"] == "10"
        with client.stream("GET", f"/v1/jobs/{job['id']}/events") as answer:
            told = events(answer.iter_lines())
            assert json.loads(next(told)[1])["state"] == "queued"
            service.process.terminate()
            assert list(told) == []
            assert service.process.wait(WAIT_S) == 0
