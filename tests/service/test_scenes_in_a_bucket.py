"""Services over one bucket and one PostgreSQL: each serves what another imports, and what is cached without S3."""

import hashlib

import httpx
import numpy as np
import pytest

from ultragray_proto.v1 import geometry_pb2, rendering_pb2, rendering_pb2_grpc
from ultragray_workers.storage.location import open_storage

from ..object_storage import FaultyProxy, credentials
from ..waiting import wait_until

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
    return httpx.post(f"{service.http}/v1/scenes/{scene}/render", json=body, headers={"Accept": accept}, timeout=300)


@pytest.mark.long
def test_a_scene_is_imported_listed_pinned_and_deleted(replicas, scene_file, tmp_path):
    one, other = replicas
    content = scene_file.read_bytes()
    sha256 = hashlib.sha256(content).hexdigest()
    assert httpx.put(f"{one.http}/v1/scenes/liver", content=content, timeout=300).status_code == 201
    assert render(other, "liver").status_code == 200  # at once, though its list may be two seconds old
    refused = httpx.put(f"{other.http}/v1/scenes/liver", content=content, timeout=300)
    assert (refused.status_code, refused.json()["reason"]) == (409, "SCENE_EXISTS")
    for replica in replicas:
        listed = {
            scene["name"]: scene for scene in httpx.get(f"{replica.http}/v1/scenes", timeout=300).json()["scenes"]
        }
        assert listed["liver"]["removable"]
        assert listed["liver"]["gaussian_count"] == 60
        assert not listed["demo"]["removable"]
        assert render(replica, f"liver@{sha256[:12]}").content == render(replica, "liver").content
        refused = render(replica, f"liver@{'0' * 64}")
        assert (refused.status_code, refused.json()["reason"]) == (404, "SCENE_NOT_FOUND")
        assert f"liver@{sha256}" in refused.json()["detail"]
        assert httpx.get(f"{replica.http}/v1/scenes/liver/file", timeout=300).content == content
        assert httpx.get(f"{replica.http}/v1/scenes/liver@{sha256}", timeout=300).json()["name"] == "liver"
    with other.channel() as channel:
        pose = geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=np.eye(4).ravel().tolist()))
        settings = rendering_pb2.RenderSettings(scene=f"liver@{sha256}", height=16, width=16)
        asked = rendering_pb2.RenderRequest(settings=settings, pose=pose)
        assert rendering_pb2_grpc.RenderServiceStub(channel).Render(asked).scene_sha256 == sha256
    assert httpx.delete(f"{one.http}/v1/scenes/demo", timeout=300).json()["reason"] == "SCENE_READ_ONLY"
    assert httpx.delete(f"{other.http}/v1/scenes/liver", timeout=300).status_code == 204
    assert render(other, "liver").status_code == 404
    wait_until(lambda: render(one, "liver").status_code == 404, within_s=WITHIN_S)
