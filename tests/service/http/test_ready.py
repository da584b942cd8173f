"""Ready means: frames are rendered, and jobs are taken. Who cannot write down a job is not ready for it."""

import httpx
import numpy as np
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from ...waiting import wait_until
from ..tls.test_healthcheck import check

IN_ORDER = {"ready": True, "detail": None}
NOT_SERVING, SERVING = health_pb2.HealthCheckResponse.NOT_SERVING, health_pb2.HealthCheckResponse.SERVING
FILE = "jobs.sqlite"
_WRITE_VERSION, _CHANGE_COUNTER = 18, slice(24, 28)  # of the header of a SQLite file


def ready(service):
    answer = httpx.get(f"{service.http}/v1/health/ready", timeout=300)
    return answer.status_code, answer.json()


def wait_for(service, status):
    return wait_until(lambda: (said := ready(service))[0] == status and said[1], every_s=0.2) or {}


def health(service, name):
    with service.channel() as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        return int(stub.Check(health_pb2.HealthCheckRequest(service=name), timeout=300).status)


def renders(service, pose_body):
    body = {"poses": [pose_body], "height": 16, "width": 16}
    return httpx.post(f"{service.http}/v1/scenes/demo/render", json=body, timeout=300).status_code


def make_read_only(file):
    """Marks a SQLite file as one of a later format, which may be read and not written: modes do not bind root."""
    header = bytearray(file.read_bytes()[:100])
    header[_WRITE_VERSION] = 3
    counted = int.from_bytes(header[_CHANGE_COUNTER], "big") + 1
    header[_CHANGE_COUNTER] = counted.to_bytes(4, "big")
    with file.open("r+b") as opened:
        opened.write(header)


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "artifacts"


@pytest.fixture
def service(start_service, folder):
    return start_service(artifact_folder=folder)


def test_a_service_whose_sqlite_file_was_removed_is_not_ready_until_it_is_back(service, folder, tmp_path, pose_body):
    status, said = ready(service)
    in_order = dict.fromkeys(("frames", "jobs", "artifacts", "scenes"), IN_ORDER)
    assert (status, said["status"], said["components"]) == (200, "ready", in_order)
    (folder / FILE).rename(tmp_path / FILE)
    problem = wait_for(service, 503)
    assert problem["reason"] == "DATABASE_UNAVAILABLE"
    assert "removed or replaced" in problem["detail"]
    assert problem["components"] == {**in_order, "jobs": {"ready": False, "detail": problem["detail"]}}
    assert check(service).returncode == 1, "the health check of containers follows"
    assert renders(service, pose_body) == 200
    wait_until(lambda: health(service, "") == NOT_SERVING)
    assert health(service, "ultragray.v1.JobService") == NOT_SERVING
    assert health(service, "ultragray.v1.RenderService") == SERVING
    assert health(service, "ultragray.v1.DatasetService") == SERVING
    (tmp_path / FILE).rename(folder / FILE)
    wait_for(service, 200)
    wait_until(lambda: health(service, "ultragray.v1.JobService") == SERVING)
    assert health(service, "") == SERVING
    with service.channel() as channel:
        asked = health_pb2.HealthCheckRequest(service="ultragray.v1.JobService")
        watching = health_pb2_grpc.HealthStub(channel).Watch(asked, timeout=300)
        while next(watching).status != SERVING:
            pass
        service.process.terminate()
        assert next(watching).status == NOT_SERVING


def test_a_service_whose_sqlite_file_is_read_only_is_not_ready(service, folder):
    make_read_only(folder / FILE)
    problem = wait_for(service, 503)
    assert (problem["reason"], problem["components"]["artifacts"]) == ("DATABASE_UNAVAILABLE", IN_ORDER)
    assert "read-only" in problem["components"]["jobs"]["detail"]
    specification = {"scene": "demo", "poses": [np.eye(4).tolist()]}
    body = {"kind": "render", "specification": specification}
    refused = httpx.post(f"{service.http}/v1/jobs", json=body, timeout=300)
    assert (refused.status_code, refused.json()["reason"]) == (503, "DATABASE_UNAVAILABLE"), refused.text


def test_a_service_without_its_share_is_not_ready(service, folder, tmp_path):
    folder.rename(tmp_path / "unmounted")
    folder.mkdir()
    wait_for(service, 503)
    wait_until(lambda: not any(ready(service)[1]["components"][name]["ready"] for name in ("artifacts", "jobs")))
    assert str(tmp_path) not in str(ready(service))


def test_a_service_that_only_renders_is_ready_without_jobs_and_tells(start_service, folder):
    service = start_service(artifact_folder=folder, ready_without_jobs=True)
    (folder / FILE).unlink()
    wait_until(lambda: not ready(service)[1]["components"]["jobs"]["ready"], every_s=0.2)
    assert ready(service)[0] == 200
    wait_until(lambda: health(service, "ultragray.v1.JobService") == NOT_SERVING)
    assert health(service, "") == SERVING


@pytest.mark.long
@pytest.mark.parametrize(
    ("take_away", "give_back", "said"),
    [
        pytest.param(lambda server, url: server.stop(), lambda server, url: server.start(), "answer", id="stopped"),
        pytest.param(lambda server, url: server.pause(), lambda server, url: server.resume(), "answer", id="silent"),
        pytest.param(
            lambda server, url: server.set_read_only(url, True),
            lambda server, url: server.set_read_only(url, False),
            "read-only",
            id="read-only",
        ),
    ],
)
def test_a_service_whose_server_is_away_or_read_only_is_not_ready_until_it_is_back(
    start_service, postgres, folder, take_away, give_back, said
):
    url = postgres.create_database()
    service = start_service(artifact_folder=folder, database_url=url)
    assert ready(service)[0] == 200
    take_away(postgres, url)
    try:
        problem = wait_for(service, 503)
        wait_until(lambda: said in str(ready(service)[1]["components"]["jobs"]["detail"]))
        assert (problem["reason"], problem["components"]["frames"]) == ("DATABASE_UNAVAILABLE", IN_ORDER)
    finally:
        give_back(postgres, url)
    wait_for(service, 200)
