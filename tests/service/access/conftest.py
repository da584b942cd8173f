"""A service with keys of every kind, and things that belong to one of them."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
import sqlalchemy as sa

from ultragray_service.access.keys import KeyStore
from ultragray_service.access.principals import Role
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.tables import KEYS

from ..conftest import DEMO_PROBE, RunningService, make_scene
from ..http.test_http_datasets import released_files, zipped

POSE = {"position_mm": {"x": 0, "y": 0, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}
MATRIX = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
ROLES = {"reader": Role.READER, "alice": Role.OPERATOR, "bob": Role.OPERATOR, "admin": Role.ADMIN}


@dataclass(frozen=True)
class Keyed:
    """A service, and the keys of those who use it: nobody has none, alice and bob are operators."""

    service: RunningService
    keys: Mapping[str, str | None]
    client: httpx.Client  # without a key
    artifact_folder: Path

    def headers(self, who):
        key = self.keys[who]
        return {} if key is None else {"x-api-key": key}

    def http(self, who, method, path, **options):
        return self.client.request(method, path, headers=self.headers(who), **options)

    def submit(self, who, *, private=False, scene="demo", **more):
        body = {"kind": "render", "specification": {"scene": scene, "poses": [MATRIX]}, "private": private, **more}
        return self.http(who, "POST", "/v1/jobs", json=body)


@pytest.fixture(scope="module")
def keyed(start_service, artifacts):
    folder = artifacts
    database = JobDatabase(folder, None)
    store = KeyStore(database.engine)
    keys = {"nobody": None, "wrong": "ultragray_" + 43 * "0"}
    for name, role in {"expired": Role.ADMIN, "revoked": Role.ADMIN, **ROLES}.items():
        _, keys[name] = store.create(name, role, 1.0)
    store.revoke("revoked")
    with database.engine.begin() as connection:
        connection.execute(sa.update(KEYS).where(KEYS.c.name == "expired").values(expires_at_s=time.time()))
    database.close()
    service = start_service(artifact_folder=folder)
    with httpx.Client(base_url=service.http, timeout=300) as client:
        yield Keyed(service, keys, client, folder)


@pytest.fixture(scope="session")
def scene_bytes(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.ugr"
    make_scene(30, seed=5, probe=DEMO_PROBE).save(path)
    return path.read_bytes()


@pytest.fixture(scope="session")
def dataset_bytes(tmp_path_factory):
    return zipped(released_files(Path(tmp_path_factory.mktemp("dataset")) / "tiny"))
