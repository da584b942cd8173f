"""Services over one bucket and one PostgreSQL: each serves what another imports, and what is cached without S3."""

import hashlib
import time

import httpx
import numpy as np
import pytest

from ultragray_proto.v1 import geometry_pb2, rendering_pb2, rendering_pb2_grpc
from ultragray_workers.storage.location import open_storage

from ..object_storage import AWAY_S, FaultyProxy, credentials
from ..waiting import Deadline, at_this_load, wait_until
from .conftest import DEMO_PROBE, make_scene

WITHIN_S = 10.0


@pytest.fixture(scope="module")
def proxy(object_server):
    proxy = FaultyProxy(object_server.port)
    yield proxy
    proxy.close()


@pytest.fixture(scope="module")
def replicas(start_service, object_server, proxy, postgres, data_folder, tmp_path_factory):
    """Two services over a bucket in which an operator has put the scene `demo`."""
    cache = tmp_path_factory.mktemp("cache")
    url, database = f"s3://{object_server.create_bucket()}/scenes", postgres.create_database()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in credentials(proxy.port).items():
            patch.setenv(name, value)
        open_storage(url).upload(data_folder / "demo.ugr", "demo.ugr")
        return [
            start_service(
                data_folder=url, database_url=database, cache_folder=cache, preload="demo" if number == 0 else ""
            )
            for number in range(2)
        ]


def render(service, scene, accept="application/octet-stream"):
    body = {"poses": [{"matrix": np.eye(4).tolist()}], "height": 32, "width": 32, "dtype": "uint8"}
    return httpx.post(f"{service.http}/v1/scenes/{scene}/render", json=body, headers={"Accept": accept}, timeout=60)


@pytest.mark.long
def test_a_scene_is_imported_listed_pinned_and_deleted(replicas, scene_file, tmp_path):
    one, other = replicas
    content = scene_file.read_bytes()
    sha256 = hashlib.sha256(content).hexdigest()
    assert httpx.put(f"{one.http}/v1/scenes/liver", content=content, timeout=60).status_code == 201
    assert render(other, "liver").status_code == 200  # at once, though its list may be two seconds old
    refused = httpx.put(f"{other.http}/v1/scenes/liver", content=content, timeout=60)
    assert (refused.status_code, refused.json()["reason"]) == (409, "SCENE_EXISTS")
    for replica in replicas:
        listed = {scene["name"]: scene for scene in httpx.get(f"{replica.http}/v1/scenes").json()["scenes"]}
        assert listed["liver"]["removable"]
        assert listed["liver"]["gaussian_count"] == 60
        assert not listed["demo"]["removable"]
        assert render(replica, f"liver@{sha256[:12]}").content == render(replica, "liver").content
        refused = render(replica, f"liver@{'0' * 64}")
        assert (refused.status_code, refused.json()["reason"]) == (404, "SCENE_NOT_FOUND")
        assert f"liver@{sha256}" in refused.json()["detail"]
        assert httpx.get(f"{replica.http}/v1/scenes/liver/file").content == content
        assert httpx.get(f"{replica.http}/v1/scenes/liver@{sha256}").json()["name"] == "liver"
    with other.channel() as channel:
        pose = geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=np.eye(4).ravel().tolist()))
        settings = rendering_pb2.RenderSettings(scene=f"liver@{sha256}", height=16, width=16)
        asked = rendering_pb2.RenderRequest(settings=settings, pose=pose)
        assert rendering_pb2_grpc.RenderServiceStub(channel).Render(asked).scene_sha256 == sha256
    assert httpx.delete(f"{one.http}/v1/scenes/demo").json()["reason"] == "SCENE_READ_ONLY"
    assert httpx.delete(f"{other.http}/v1/scenes/liver").status_code == 204
    assert render(other, "liver").status_code == 404
    wait_until(lambda: render(one, "liver").status_code == 404, within_s=WITHIN_S)


@pytest.mark.long
def test_what_is_cached_is_served_while_the_bucket_is_away(replicas, proxy, tmp_path):
    one, other = replicas
    for seed, name in enumerate(("cached", "elsewhere")):
        make_scene(60, probe=DEMO_PROBE, seed=seed).save(tmp_path / f"{name}.ugr")
        content = (tmp_path / f"{name}.ugr").read_bytes()
        assert httpx.put(f"{other.http}/v1/scenes/{name}", content=content, timeout=60).status_code == 201
    frame = render(one, "demo").content
    wait_until(lambda: "elsewhere" in httpx.get(f"{one.http}/v1/scenes").text, within_s=WITHIN_S)
    proxy.away = True
    try:

        def away():
            return not httpx.get(f"{one.http}/v1/health/ready").json()["components"]["scenes"]["ready"]

        wait_until(away, within_s=30)
        ready = httpx.get(f"{one.http}/v1/health/ready")
        assert ready.status_code == 503 or ready.json()["status"] == "ready"
        end = Deadline(AWAY_S)
        while not end.passed:
            began = time.monotonic()
            assert render(one, "demo").content == frame
            assert time.monotonic() - began < at_this_load(5.0)
            time.sleep(0.1)
        refused = render(one, "elsewhere")
        assert (refused.status_code, refused.json()["reason"]) == (503, "STORAGE_UNAVAILABLE")
        assert refused.headers["retry-after"] == "5"
        assert one.metric("ultragray_scene_list_errors_total") > 0
    finally:
        proxy.away = False
    wait_until(lambda: not away(), within_s=30)
    assert render(one, "elsewhere").status_code == 200
    assert one.metric("ultragray_scene_cache_misses_total") > 0
    assert one.metric("ultragray_scene_cache_hits_total") > 0
    assert "Traceback" not in one.log_path.read_text()
