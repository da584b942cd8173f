"""A real Envoy with the configuration of docker/envoy, on free ports."""

import shutil
import socket
import subprocess
import time
from importlib.util import find_spec
from pathlib import Path

import httpx
import pytest
import yaml

from ..scripts import loaded
from ..surroundings import ROOT
from ..waiting import wait_until

FOLDER = ROOT / "docker" / "envoy"
_TOLD_ALL_THREADS_S = 1.0  # after the statistics know it
_CLUSTERS = ("http_by_scene", "http_any", "grpc_by_scene", "grpc_any")


def program():
    """The program. Skips the test where there is none."""
    if (found := shutil.which("envoy")) is not None:
        return Path(found)
    if (package := find_spec("envoy")) is not None and package.origin is not None:
        return Path(package.origin).parent / "_bin" / "envoy"
    pytest.skip("there is no Envoy: pip install 'ultragray[envoy]'")


def script():
    """docker/envoy/configure.py."""
    return loaded(FOLDER / "configure.py")


class Envoy:
    """A proxy before replicas, listening when it is made; ends with the `with` block."""

    def __init__(self, folder, replicas, hot_scenes=None):
        """`replicas`: of the script. Skips the test where there is no Envoy."""
        executable = program()
        http_port, grpc_port, self._admin_port = _free_ports(3)
        made = script().configured(
            replicas,
            address="127.0.0.1",
            http_port=http_port,
            grpc_port=grpc_port,
            admin_port=self._admin_port,
            hot_scenes=hot_scenes,
        )
        self.http, self.grpc = f"http://127.0.0.1:{http_port}", f"127.0.0.1:{grpc_port}"
        self._log = folder / "envoy.log"
        configuration = folder / "envoy.yaml"
        configuration.write_text(yaml.safe_dump(made))
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [executable, "-c", configuration, "--concurrency", "2", "--log-level", "warn", "--use-dynamic-base-id"],
                stdout=log,
                stderr=log,
            )
        self._replicas = len(replicas)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.terminate()
        self._process.wait(300)

    def wait_for(self, healthy=None):
        """Until so many replicas are healthy at every door, as all threads of Envoy know; None: all."""
        wanted = self._replicas if healthy is None else healthy
        wait_until(lambda: set(self._healthy().values()) == {wanted}, within_s=60, every_s=0.1)
        time.sleep(_TOLD_ALL_THREADS_S)

    def _healthy(self):
        try:
            stats = self._told("/stats?format=json&filter=membership_healthy")["stats"]
        except httpx.TransportError:
            assert self._process.poll() is None, self._log.read_text()
            return {}
        values = {one["name"]: one["value"] for one in stats}
        return {cluster: values.get(f"cluster.{cluster}.membership_healthy", 0) for cluster in _CLUSTERS}

    def _told(self, path):
        return httpx.get(f"http://127.0.0.1:{self._admin_port}{path}", timeout=10).json()


def _free_ports(count):
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports
