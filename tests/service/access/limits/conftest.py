"""A service whose keys have limits, each its own, and ways to ask it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import grpc
import httpx
import pytest
from google.rpc.error_details_pb2 import RetryInfo
from google.rpc.status_pb2 import Status

from ultragray_proto.v1 import rendering_pb2, rendering_pb2_grpc
from ultragray_service.access.keys import KeyStore
from ultragray_service.access.principals import Role, read_limits
from ultragray_workers.jobs.database import JobDatabase

from ...conftest import RunningService, StartService
from ...rpc.test_grpc_render import error_info, moved
from ..conftest import POSE

LIMITS = {  # by the name of the key
    "requests": "requests_per_s=1",
    "calls": "requests_per_s=1",
    "frames": "frames_per_s=1",
    "rpc-frames": "frames_per_s=1",
    "poses": "frames_per_s=4",
    "batch": "frames_per_s=4",
    "ordered": "frames_per_s=4",
    "latest": "frames_per_s=2",
    "rpc-latest": "frames_per_s=2",
    "client": "frames_per_s=2",
    "streams": "streams=1",
    "greedy": "requests_per_s=5",
    "polite": "requests_per_s=none",
    "unlimited": "streams=none",
    "jobs": "unfinished_jobs=2",
    "rpc-jobs": "unfinished_jobs=1",
    "minutes": "compute_minutes_per_day=1",
    "bytes": "stored_gb=0.000004",
    "unpacked": "stored_gb=0.000005",
    "full": "stored_gb=0",
    "registrations": "registrations=2",
}
SMALL = {"height": 16, "width": 16}


@dataclass(frozen=True)
class Limited:
    """The service, and a key for each limit."""

    service: RunningService
    keys: Mapping[str, str]
    client: httpx.Client
    channel: grpc.Channel
    database: JobDatabase

    def http(self, who: str, method: str, path: str, **options: Any) -> httpx.Response:
        return self.client.request(method, path, headers={"x-api-key": self.keys[who]}, **options)

    def render(self, who: str, **body: Any) -> httpx.Response:
        poses = {} if "poses" in body else {"pose": POSE}
        return self.http(who, "POST", "/v1/scenes/demo/render", json={**SMALL, **poses, **body})

    def metadata(self, who: str) -> tuple[tuple[str, str], ...]:
        return (("x-api-key", self.keys[who]),)

    def renders(self) -> rendering_pb2_grpc.RenderServiceStub:
        return rendering_pb2_grpc.RenderServiceStub(self.channel)

    def refusals(self, limit: str, role: str = "operator") -> float:
        """How often a limit refused somebody, by the metrics."""
        headers = {"x-api-key": self.keys["unlimited"]}
        lines = self.client.get("/metrics", headers=headers).text.splitlines()
        name = f'ultragray_limited_total{{limit="{limit}",role="{role}"}}'
        return sum(float(line.rpartition(" ")[2]) for line in lines if line.startswith(name))


@pytest.fixture(scope="module")
def limited(start_service: StartService, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Limited]:
    folder = tmp_path_factory.mktemp("artifacts")
    database = JobDatabase(folder, None)
    store = KeyStore(database.engine)
    keys = {name: store.create(name, Role.OPERATOR, None, read_limits([limit]))[1] for name, limit in LIMITS.items()}
    service = start_service(artifact_folder=folder, key_streams=1)
    with httpx.Client(base_url=service.http, timeout=120) as client, service.channel() as channel:
        yield Limited(service, keys, client, channel, database)
    database.close()


def render_request() -> rendering_pb2.RenderRequest:
    return rendering_pb2.RenderRequest(settings=render_settings(), pose=moved(0))


def render_settings() -> rendering_pb2.RenderSettings:
    return rendering_pb2.RenderSettings(scene="demo", **SMALL)


def retry_after_s(error: grpc.RpcError, reason: str) -> float | None:
    """The delay of RetryInfo, where there is one, of a call that a limit refused."""
    assert error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    assert error_info(error)[0].reason == reason
    status = Status.FromString(dict(error.trailing_metadata())["grpc-status-details-bin"])
    delay = RetryInfo()
    found = [detail for detail in status.details if detail.Is(RetryInfo.DESCRIPTOR)]
    if not found:
        return None
    found[0].Unpack(delay)
    return float(delay.retry_delay.ToTimedelta().total_seconds())
