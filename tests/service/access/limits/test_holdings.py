"""Limits of the jobs, minutes and bytes of a key, at the doors of a real service; no worker takes the jobs."""

from __future__ import annotations

from datetime import datetime, timezone
from typing import Any

import grpc
import httpx
import pytest
import sqlalchemy as sa

from ultragray_proto.v1 import jobs_pb2, jobs_pb2_grpc
from ultragray_workers.jobs.tables import USAGE

from ...rpc.test_grpc_render import moved
from ..conftest import MATRIX
from .conftest import Limited, retry_after_s

DAY_S = 86_400


def submit(limited: Limited, who: str, **more: Any) -> httpx.Response:
    body = {"kind": "render", "specification": {"scene": "demo", "poses": [MATRIX]}, **more}
    return limited.http(who, "POST", "/v1/jobs", json=body)


def is_limit(answer: httpx.Response, name: str) -> bool:
    return (answer.status_code, answer.json()["reason"]) == (429, "LIMIT_REACHED") and name in answer.json()["detail"]


def ran(limited: Limited, device: str) -> None:
    """Half a minute on a device, of a job that has been deleted."""
    with limited.database.engine.begin() as connection:
        values = {"owner": "minutes", "device": device, "day": datetime.now(timezone.utc).date(), "run_s": 30.0}
        connection.execute(sa.insert(USAGE).values(values))


def test_only_so_many_jobs_of_a_key_wait_or_run(limited: Limited) -> None:
    first, second = (submit(limited, "jobs", request_id=name) for name in ("one", "two"))
    assert (first.status_code, second.status_code) == (201, 201)
    beyond = submit(limited, "jobs")
    assert is_limit(beyond, "unfinished_jobs")
    assert "Retry-After" not in beyond.headers
    assert submit(limited, "jobs", request_id="one").status_code == 200  # it is there already
    assert submit(limited, "unlimited").status_code == 201
    job = f"/v1/jobs/{first.json()['id']}"
    assert limited.http("jobs", "POST", f"{job}:cancel").status_code == 200
    assert limited.http("jobs", "POST", f"{job}:retry").status_code == 201
    assert is_limit(submit(limited, "jobs"), "unfinished_jobs")
    assert limited.refusals("unfinished_jobs") >= 2


def test_jobs_of_grpc_count_likewise(limited: Limited) -> None:
    jobs = jobs_pb2_grpc.JobServiceStub(limited.channel)
    request = jobs_pb2.SubmitJobRequest(render=jobs_pb2.RenderJob(scene="demo", poses=[moved(0)]))
    metadata = limited.metadata("rpc-jobs")
    job = jobs.SubmitJob(request, metadata=metadata, timeout=60).job
    with pytest.raises(grpc.RpcError) as caught:
        jobs.SubmitJob(request, metadata=metadata, timeout=60)
    assert retry_after_s(caught.value, "LIMIT_REACHED") is None
    jobs.CancelJob(jobs_pb2.CancelJobRequest(job=job.id), metadata=metadata, timeout=60)
    jobs.SubmitJob(request, metadata=metadata, timeout=60)
    with pytest.raises(grpc.RpcError) as caught:
        jobs.RetryJob(jobs_pb2.RetryJobRequest(job=job.id), metadata=metadata, timeout=60)
    assert retry_after_s(caught.value, "LIMIT_REACHED") is None


def test_the_minutes_of_a_day_end_at_midnight(limited: Limited) -> None:
    ran(limited, "cpu")
    assert submit(limited, "minutes").status_code == 201
    ran(limited, "gpu")
    refused = submit(limited, "minutes")
    assert is_limit(refused, "compute_minutes_per_day")
    assert 0 < int(refused.headers["Retry-After"]) <= DAY_S + 2
    assert submit(limited, "polite").status_code == 201


@pytest.mark.long
def test_uploads_end_where_the_bytes_of_a_key_end(limited: Limited, scene_bytes: bytes, dataset_bytes: bytes) -> None:
    def put(who: str, path: str, content: bytes) -> httpx.Response:
        return limited.http(who, "PUT", f"/v1/{path}", content=content)

    assert is_limit(put("bytes", "datasets/packed", dataset_bytes), "stored_gb")
    assert put("bytes", "scenes/one", scene_bytes).status_code == 201
    assert is_limit(put("bytes", "scenes/two", scene_bytes), "stored_gb")
    assert limited.http("bytes", "DELETE", "/v1/scenes/one").status_code == 204
    assert put("bytes", "scenes/two", scene_bytes).status_code == 201
    assert is_limit(put("unpacked", "datasets/unpacked", dataset_bytes), "stored_gb")
    stored = put("unlimited", "datasets/unpacked", dataset_bytes)
    assert stored.status_code == 201
    assert len(dataset_bytes) < 5000 < stored.json()["bytes"]
    for refused in (put("full", "scenes/full", scene_bytes), put("full", "datasets/full", dataset_bytes)):
        assert is_limit(refused, "stored_gb")
    assert is_limit(submit(limited, "full"), "stored_gb")


def test_a_key_keeps_only_so_many_registrations(limited: Limited) -> None:
    def put(who: str, name: str) -> httpx.Response:
        body = {"scene": "demo", "base_to_scene": MATRIX}
        return limited.http(who, "PUT", f"/v1/registrations/{name}", json=body)

    assert [put("registrations", name).status_code for name in ("one", "two", "one")] == [200, 200, 200]
    assert is_limit(put("registrations", "three"), "registrations")
    assert put("unlimited", "three").status_code == 200
    assert limited.http("registrations", "DELETE", "/v1/registrations/one").status_code == 204
    assert put("registrations", "four").status_code == 200
    assert limited.refusals("registrations") == 1
