"""The service with its queue in PostgreSQL: a scene is trained and served, and an outage of the database passes."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest

from ..postgres import PASSWORD, PostgresServer
from ..waiting import at_this_load, wait_until
from ..workers.jobs.conftest import store_dataset
from .conftest import RunningService

StartService = Callable[..., RunningService]
WAIT_S = 60.0


def submit(client: httpx.Client, scene: str, steps: int) -> str:
    settings = {"steps": steps, "max_gaussians": 40, "batch_size": 2}
    specification = {"dataset": "tiny", "scene": scene, "settings": settings, "device": "cpu"}
    answer = client.post("/v1/jobs", json={"kind": "train", "specification": specification})
    assert answer.status_code == 201, answer.text
    job_id: str = answer.json()["id"]
    return job_id


def watch(client: httpx.Client, job_id: str, told: list[dict[str, Any]]) -> None:
    """Adds every state of the job that is told, to the last."""
    with client.stream("GET", f"/v1/jobs/{job_id}/events", timeout=WAIT_S) as answer:
        told += [json.loads(line[6:]) for line in answer.iter_lines() if line.startswith('data: {"id"')]


@pytest.mark.long
def test_scene_is_trained_and_served_and_an_outage_passes(
    start_service: StartService, postgres: PostgresServer, tmp_path: Path, pose_body: dict[str, Any]
) -> None:
    store_dataset(tmp_path, "tiny")
    service = start_service(
        artifact_folder=tmp_path, database_url=postgres.create_database(), embedded_worker=True, training_threads=1
    )

    def render() -> int:
        body = {"poses": [pose_body], "height": 16, "width": 16}
        return client.post("/v1/scenes/made/render", json=body, headers={"Accept": "image/png"}).status_code

    with httpx.Client(base_url=service.http, timeout=WAIT_S) as client:
        told: list[dict[str, Any]] = []
        watch(client, submit(client, "made", 20), told)
        assert told[-1]["state"] == "succeeded", told
        assert render() == 200
        assert not (tmp_path / "jobs.sqlite").exists()

        long = submit(client, "long", 1_000_000)
        told = []
        watching = threading.Thread(target=watch, args=(client, long, told))
        watching.start()
        wait_until(lambda: client.get(f"/v1/jobs/{long}").json()["progress"]["step"], within_s=WAIT_S, every_s=0.1)
        postgres.stop()
        try:
            for route in ("/v1/jobs", f"/v1/jobs/{long}"):
                answer = client.get(route)
                assert (answer.status_code, answer.json()["reason"]) == (503, "DATABASE_UNAVAILABLE")
                assert answer.headers["retry-after"] == "5"
            assert client.post(f"/v1/jobs/{long}:cancel").status_code == 503
            assert render() == 200
            wait_until(lambda: client.get("/v1/health/ready").status_code == 503, every_s=0.1)
            time.sleep(1.0)
        finally:
            postgres.start()
        assert client.get(f"/v1/jobs/{long}").json()["state"] == "running"

        postgres.pause()
        try:
            with ThreadPoolExecutor(8) as threads:
                answers = [threads.submit(client.get, "/v1/jobs") for _ in range(8)]
                time.sleep(0.5)
                for _ in range(5):
                    began = time.monotonic()
                    assert client.get("/v1/scenes").status_code == 200
                    assert time.monotonic() - began < at_this_load(0.5)
            assert {answer.result().json()["reason"] for answer in answers} == {"DATABASE_UNAVAILABLE"}
            assert render() == 200
        finally:
            postgres.resume()
        assert client.post(f"/v1/jobs/{long}:cancel").json()["state"] == "cancelled"
        watching.join(WAIT_S)
        assert not watching.is_alive()
        assert told[-1]["state"] == "cancelled"
    assert service.terminate() == 0
    log = service.log_path.read_text()
    assert PASSWORD not in log
    assert "%2F" not in log
    assert "Traceback" not in log
